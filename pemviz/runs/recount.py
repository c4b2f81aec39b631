"""A result held to the rollouts beside it: verdicts, counts, and estimates formed again."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, row_sums
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError, InputError
from pemviz.files.array_files import map_arrays
from pemviz.runs.coherence import differences
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import BROKEN, COLUMN, LATENTS, log_weights
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.kept import KeptRepetition, KeptStage, Recounted, log_of
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

ROLLOUTS = "rollouts.npz"
AT_ONCE = 10_000
"""Rollouts whose steps are read at a time."""
MOST_RECOUNTED = 20_000_000
"""Rollouts; what a damaged file claims is not to take more memory than there is."""
PER_OUTCOME = ("detected", "log_p", "log_q")
Recount = Callable[[KeptRepetition], Recounted]
KINDS = {"repetition": "i", "stage": "i", "robustness": "f", "violated": "b"}


def recount(folder: Path, result: RunResult) -> Iterator[str]:
    """What the rollouts of a run that is done say otherwise, a line each that names the field.

    Raises:
        InputError: The rollouts are damaged.
    """
    path = folder / ROLLOUTS
    if result.status != "done" or not path.is_file():
        return
    arrays = map_arrays(path)
    try:
        yield from _complaints(arrays, result)
    except (KeyError, ValueError, TypeError, IndexError, ArithmeticError) as error:
        message = f"rollouts {path}: do not fit together ({error})"
        raise InputError(message) from error


def _complaints(arrays: Mapping[str, AnyArray], result: RunResult) -> Iterator[str]:
    columns = _checked(arrays)
    yield from _verdicts(columns, result.config)
    place, wrong = _places(columns, result)
    if wrong is not None:
        yield wrong
        return
    yield from _stage_counts(columns["violated"], place, result)
    recounted = _again(result.config)
    drawn = sum(stage.rollouts for stage in result.stages)
    if recounted is None or not result.repetitions or drawn > MOST_RECOUNTED:
        return
    found = _Found.of(arrays, place, result)
    kept = [found.repetition(number) for number in range(len(result.repetitions))]
    every = [_formed(recounted, one) for one in kept]
    for number, (said, one) in enumerate(zip(result.repetitions, every, strict=True)):
        yield from _differences(f"repetitions[{number}]", said, one)
    for number, rule in enumerate(result.rules):
        under = [
            _formed(recounted, found.under_rule(one, n, rule.name)) for n, one in enumerate(kept)
        ]
        yield from _differences(f"rules[{number}].estimate", rule.estimate, _together(under))


def _formed(recounted: Recount, kept: KeptRepetition) -> Recounted:
    """What a repetition's rollouts give; numbers of an edited file may be beyond all bounds."""
    with np.errstate(all="ignore"):
        return recounted(kept)


def _again(config: ExperimentConfig) -> Recount | None:
    """How its method forms an estimate again; ``None`` where that is not known here."""
    try:
        return by_name(config.method).recount
    except ConfigError:
        return None


def _differences(name: str, said: Estimate, found: Recounted) -> Iterator[str]:
    return differences(name, said, found.estimate, source=ROLLOUTS, among=found.names)


def _together(repetitions: Sequence[Recounted]) -> Recounted:
    """Of all repetitions; what is not known of each is not known of all."""
    with np.errstate(all="ignore"):
        estimate = summarise_repetitions([one.estimate for one in repetitions])
    return Recounted(estimate, repetitions[0].names)


def _checked(arrays: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """What there is a number of for each rollout.

    Raises:
        ValueError: Something is of another type or size.
    """
    count = arrays["violated"].size
    kinds = KINDS | {name: "b" for name in arrays if name.startswith(BROKEN)}
    kinds |= {name: "if" for name in arrays if name.startswith(COLUMN)}
    for name, kind in kinds.items():
        values = arrays[name]
        if values.shape != (count,) or values.dtype.kind not in kind:
            message = f"{name} has type {values.dtype} and shape {values.shape}"
            raise ValueError(message)
    return {name: arrays[name] for name in kinds}


def _verdicts(columns: Mapping[str, AnyArray], config: ExperimentConfig) -> Iterator[str]:
    """A rollout violates as its robustness says, and if it breaks a rule."""
    violated, robustness = columns["violated"], columns["robustness"]
    if config.metric == "classical":
        wrong = np.flatnonzero(((robustness < 0) & ~violated) | ((robustness > 0) & violated))
        if wrong.size:
            row = int(wrong[0])
            yield (
                f"{ROLLOUTS}, row {row}: violated = {bool(violated[row])}, where robustness = "
                f"{float(robustness[row])!r}"
            )
    broken = [columns[f"{BROKEN}{rule.name}"] for rule in config.rules]
    if broken:
        wrong = np.flatnonzero(np.logical_or.reduce(broken) != violated)
        if wrong.size:
            yield f"{ROLLOUTS}, row {int(wrong[0])}: violated is not that of the rules it breaks"


def _places(columns: Mapping[str, AnyArray], result: RunResult) -> tuple[IntArray, str | None]:
    """Index in ``stages`` of each rollout's stage ``[N]``; or that a stage is not told of."""
    known = {(one.repetition, one.stage): index for index, one in enumerate(result.stages)}
    pairs = np.stack([columns["repetition"], columns["stage"]], axis=1)
    begins = np.flatnonzero(np.r_[True, np.any(pairs[1:] != pairs[:-1], axis=1)][: len(pairs)])
    place = np.empty(len(pairs), dtype=np.int64)
    for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(pairs)], strict=True):
        repetition, stage = pairs[begin].tolist()
        if (repetition, stage) not in known:
            words = f"stages: {ROLLOUTS} holds repetition {repetition}, stage {stage} besides"
            return place, words
        place[begin:end] = known[repetition, stage]
    return place, None


def _stage_counts(violated: BoolArray, place: IntArray, result: RunResult) -> Iterator[str]:
    """Rollouts and failures of stages; one of which some are kept may have more."""
    kept = np.bincount(place, minlength=len(result.stages)).tolist()
    failing = np.bincount(place[violated], minlength=len(result.stages)).tolist()
    for index, stage in enumerate(result.stages):
        some = result.config.keep != "all" and kept[index] < stage.rollouts
        if not some and kept[index] != stage.rollouts:
            yield f"stages[{index}].rollouts = {stage.rollouts}: {ROLLOUTS} holds {kept[index]}"
        more_is_known = some and stage.kind != "final" and failing[index] < stage.failures
        if failing[index] != stage.failures and not more_is_known:
            yield f"stages[{index}].failures = {stage.failures}: {ROLLOUTS} holds {failing[index]}"


@dataclass(frozen=True)
class _Found:
    """The F violating rollouts of all repetitions.

    Attributes:
        result: The run's.
        place: Index in ``stages`` of each one's stage, ``[F]``.
        log_weight: ``[F]``.
        log_p: ``[F]``.
        columns: What the method keeps, ``[F]`` by name.
        broken: ``[F]`` by rule.
        slots: Outcomes of a step.
    """

    result: RunResult
    place: IntArray
    log_weight: FloatArray
    log_p: FloatArray
    columns: Mapping[str, AnyArray]
    broken: Mapping[str, BoolArray]
    slots: int

    @staticmethod
    def of(arrays: Mapping[str, AnyArray], place: IntArray, result: RunResult) -> "_Found":
        rows = np.flatnonzero(arrays["violated"])
        log_weight, log_p = _likelihoods(arrays, rows)
        detected = arrays["detected"]
        own = {name: arrays[name][rows] for name in arrays if name.startswith((COLUMN, BROKEN))}
        return _Found(
            result=result,
            place=place[rows],
            log_weight=log_weight,
            log_p=log_p,
            columns={n.removeprefix(COLUMN): v for n, v in own.items() if n.startswith(COLUMN)},
            broken={n.removeprefix(BROKEN): v for n, v in own.items() if n.startswith(BROKEN)},
            slots=detected.shape[2] if detected.ndim > 2 else 1,
        )

    def _rows(self, repetition: int) -> IntArray:
        of = np.array([stage.repetition for stage in self.result.stages], dtype=np.int64)
        return np.flatnonzero(of[self.place] == repetition)

    def repetition(self, repetition: int) -> KeptRepetition:
        """One repetition's."""
        result, rows = self.result, self._rows(repetition)
        numbers = [n for n, one in enumerate(result.stages) if one.repetition == repetition]
        return KeptRepetition(
            method=result.repetitions[repetition].method,
            stages=[
                KeptStage(one.kind, one.rollouts, one.failures, log_of(one.log10_probability))
                for one in (result.stages[number] for number in numbers)
            ],
            stage=np.searchsorted(numbers, self.place[rows]),
            log_weight=self.log_weight[rows],
            log_p=self.log_p[rows],
            columns={name: values[rows] for name, values in self.columns.items()},
            slots=self.slots,
            starts=0 if result.latents is None else result.latents.start,
        )

    def under_rule(self, kept: KeptRepetition, repetition: int, rule: str) -> KeptRepetition:
        """Those of one repetition's that break a rule."""
        return kept.under_rule(rule, self.broken[rule][self._rows(repetition)])


def _likelihoods(arrays: Mapping[str, AnyArray], rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Log weights and log likelihoods of some rollouts, a few at a time.

    Raises:
        ValueError: They are no finite numbers.
    """
    names = [*PER_OUTCOME, *(name for name in arrays if name.startswith(LATENTS))]
    log_weight, log_p = np.empty(rows.size), np.empty(rows.size)
    for begin in range(0, rows.size, AT_ONCE):
        part = slice(begin, begin + AT_ONCE)
        some = {name: np.array(arrays[name][rows[part]], order="C") for name in names}
        log_weight[part] = log_weights(some)
        log_p[part] = row_sums(some["log_p"])
    if not (np.isfinite(log_weight).all() and np.isfinite(log_p).all()):
        message = "log_p and log_q must be finite numbers"
        raise ValueError(message)
    return log_weight, log_p
