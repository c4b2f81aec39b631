"""Does a result agree with itself, and with the rollouts beside it?

With itself: bounds in order, logarithms, counts, the mean of repetitions. With ``rollouts.npz``:
verdicts, counts, and estimates formed again.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, row_sums
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError, InputError
from pemviz.files.array_files import map_arrays
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import BROKEN, COLUMN, LATENTS, ROLLOUTS_FILE, log_weights
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.kept import KeptRepetition, KeptStage, log_of
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

TOLERANCE = 1e-9
"""Relative: other versions of libraries may differ in last digits."""
LEAST = 1e-300
"""Below this a double loses digits."""
NOT_FIGURES = ("config", "versions", "timings_s")
AS_WRITTEN = {
    "explanation": "causes",
    "unbiased_probability": "unbiased.probability",
    "unbiased_std_error": "unbiased.std_error",
}
"""Fields that ``result.json`` has under other names."""
MIDDLES = ("probability", "median")
"""What an interval is about, if its record has it."""
MORE, LESS = "must be at least", "must be at most"
AT_ONCE = 10_000
"""Rollouts whose steps are read at a time."""
MOST_RECOUNTED = 20_000_000
"""Rollouts; what a damaged file claims is not to take more memory than there is."""


def complaints(result: RunResult) -> Iterator[str]:
    """What is wrong, a line each that names the field; fields of files may come from anywhere."""
    yield from disorders(result)
    if result.estimate is None or not result.repetitions or _described(result.estimate) is None:
        return
    try:
        with np.errstate(all="ignore"):
            of_all = summarise_repetitions(result.repetitions)
    except (ArithmeticError, ValueError) as error:
        yield f"repetitions: give no estimate together ({error})"
        return
    yield from _differences("estimate", result.estimate, of_all, source="repetitions")


def disorders(value: Any) -> Iterator[str]:
    """What contradicts itself in a record, or in records within it."""
    for name, record in _records(value, ""):
        yield from _out_of_order(name, record)
        yield from _counts(name, record)
        yield from _logarithm(name, record)


def recount(folder: Path, result: RunResult) -> Iterator[str]:
    """What the rollouts of a run that is done say otherwise, a line each that names the field.

    Raises:
        InputError: The rollouts are damaged.
    """
    path = folder / ROLLOUTS_FILE
    if result.status != "done" or not path.is_file():
        return
    arrays = map_arrays(path)
    try:
        yield from _contradictions(arrays, result)
    except (KeyError, ValueError, TypeError, IndexError, ArithmeticError) as error:
        raise InputError(f"rollouts {path}: do not fit together ({error})") from error


def _differences(
    name: str, said: Estimate, found: Estimate, *, source: str, among: tuple[str, ...] | None = None
) -> Iterator[str]:
    """In which figures an estimate differs from one that was formed again; ``None``: of all."""
    for one in fields(Estimate):
        first, second = getattr(said, one.name), getattr(found, one.name)
        number = not isinstance(first, str | tuple)
        if number and (among is None or one.name in among):
            scale = found.probability if one.name.endswith("std_error") else 0.0
            if not _agree(first, second, scale=scale):
                field = AS_WRITTEN.get(one.name, one.name)
                yield f"{name}.{field} = {_shown(first)}: {source} give {_shown(second)}"


def _agree(first: float | None, second: float | None, *, scale: float = 0.0) -> bool:
    """Whether two figures are the same but for rounding, of terms as large as ``scale``."""
    if first is None or second is None or not (math.isfinite(first) and math.isfinite(second)):
        return _is_undefined(first) and _is_undefined(second)
    largest = max(abs(first), abs(second), scale)
    return abs(first - second) <= max(TOLERANCE * largest, LEAST)


def _is_undefined(value: float | None) -> bool:
    return value is None or not math.isfinite(value)


def _shown(value: float | None) -> str:
    return "null" if _is_undefined(value) else f"{value!r}"


def _described(of: Estimate | ExperimentConfig) -> MethodDescription | None:
    """The method's description; ``None`` where it is not installed."""
    try:
        return by_name(of.method)
    except ConfigError:
        return None


def _records(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Every record in a result, with the name that it has in ``result.json``."""
    if is_dataclass(value):
        yield name, value
        for one in fields(value):
            if one.name not in NOT_FIGURES:
                inner = AS_WRITTEN.get(one.name, one.name)
                yield from _records(getattr(value, one.name), f"{name}.{inner}" if name else inner)
    elif isinstance(value, tuple):
        for index, item in enumerate(cast(tuple[Any, ...], value)):
            yield from _records(item, f"{name}[{index}]")
    elif isinstance(value, Mapping):
        for key, item in cast(Mapping[str, Any], value).items():
            yield from _records(item, f"{name}.{key}")


def _out_of_order(name: str, record: Any) -> Iterator[str]:
    """Ends of intervals, ``low`` and ``high`` in their names, and what lies between them."""
    names, middles = [one.name for one in fields(record)], MIDDLES
    if isinstance(record, Estimate):
        described = _described(record)
        if described is None or described.interval_basis == "runs":
            middles = ()  # the interval between runs of splitting is around another estimate
    for low in names:
        high = "_".join("high" if word == "low" else word for word in low.split("_"))
        if high == low or high not in names:
            continue
        ends, middle = (low, high), [one for one in middles if one in names]
        chain = [end for end in (low, *middle, high) if getattr(record, end) is not None]
        for lower, upper in itertools.pairwise(chain):
            least, most = getattr(record, lower), getattr(record, upper)
            if "probability" in middle:
                least, most = min(least, 1.0), min(most, 1.0)  # weights may carry a mean above 1
            if least > most and not _agree(least, most):
                wrong, other, words = (upper, lower, MORE)
                if upper not in ends:
                    wrong, other, words = (lower, upper, LESS)
                found, limit = getattr(record, wrong), getattr(record, other)
                yield f"{name}.{wrong} = {found!r}: {words} {name}.{other}, {limit!r}"


def _counts(name: str, record: Any) -> Iterator[str]:
    """Some of all are no more than all; without a failure there is no probability."""
    names = [one.name for one in fields(record)]
    chain = ("failures", "rollouts_in_estimate", "rollouts_simulated")
    if "failures" not in names:
        return
    some = [one for one in (*chain, "rollouts") if one in names]
    for fewer, more in itertools.pairwise(some):
        least, most = getattr(record, fewer), getattr(record, more)
        if least > most:
            yield f"{name}.{fewer} = {least}: {LESS} {name}.{more}, {most}"
    if "log10_probability" in names and not record.failures and record.probability:
        yield f"{name}.probability = {record.probability!r}: must be 0 without failures"


def _logarithm(name: str, record: Any) -> Iterator[str]:
    names = [one.name for one in fields(record)]
    if "probability" not in names or "log10_probability" not in names:
        return
    log10, probability = record.log10_probability, record.probability
    power = 0.0 if log10 is None else 10.0**log10
    if not _agree(probability, power):
        yield (
            f"{name}.log10_probability = {_shown(log10)}: must be that of "
            f"{name}.probability, {probability!r}"
        )


def _contradictions(arrays: Mapping[str, AnyArray], result: RunResult) -> Iterator[str]:
    columns = _columns(arrays)
    yield from _verdicts(columns, result.config)
    place, wrong = _places(columns, result)
    if wrong is not None:
        yield wrong
        return
    yield from _stage_counts(columns["violated"], place, result)
    described = _described(result.config)
    recounted = None if described is None else described.recount
    sampled = sum(stage.rollouts for stage in result.stages)
    if recounted is None or not result.repetitions or sampled > MOST_RECOUNTED:
        return
    kept, broken = _kept_repetitions(arrays, place, result)
    with np.errstate(all="ignore"):  # numbers of an edited file may be beyond all bounds
        every = [recounted(one) for one in kept]
    for number, (said, one) in enumerate(zip(result.repetitions, every, strict=True)):
        name, among = f"repetitions[{number}]", one.names
        yield from _differences(name, said, one.estimate, source=ROLLOUTS_FILE, among=among)
    for number, rule in enumerate(result.rules):
        with np.errstate(all="ignore"):
            under = [
                recounted(one.under_rule(rule.name, some[rule.name]))
                for one, some in zip(kept, broken, strict=True)
            ]
            estimate = summarise_repetitions([one.estimate for one in under])
        name, among = f"rules[{number}].estimate", under[0].names
        yield from _differences(name, rule.estimate, estimate, source=ROLLOUTS_FILE, among=among)


def _columns(arrays: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """What there is a number of for each rollout; it must be of its type and size."""
    count = arrays["violated"].size
    kinds = {"repetition": "i", "stage": "i", "robustness": "f", "violated": "b"}
    kinds |= {name: "b" for name in arrays if name.startswith(BROKEN)}
    kinds |= {name: "if" for name in arrays if name.startswith(COLUMN)}
    for name, kind in kinds.items():
        values = arrays[name]
        if values.shape != (count,) or values.dtype.kind not in kind:
            raise ValueError(f"{name} has type {values.dtype} and shape {values.shape}")
    return {name: arrays[name] for name in kinds}


def _verdicts(columns: Mapping[str, AnyArray], config: ExperimentConfig) -> Iterator[str]:
    """A rollout violates as its robustness says, and if it breaks a rule."""
    violated, robustness = columns["violated"], columns["robustness"]
    if config.metric == "classical":
        wrong = np.flatnonzero(((robustness < 0) & ~violated) | ((robustness > 0) & violated))
        if wrong.size:
            row = int(wrong[0])
            yield (
                f"{ROLLOUTS_FILE}, row {row}: violated = {bool(violated[row])}, where robustness = "
                f"{float(robustness[row])!r}"
            )
    broken = [columns[f"{BROKEN}{rule.name}"] for rule in config.rules]
    if broken:
        wrong = np.flatnonzero(np.logical_or.reduce(broken) != violated)
        if wrong.size:
            row = int(wrong[0])
            yield f"{ROLLOUTS_FILE}, row {row}: violated is not that of the rules it breaks"


def _places(columns: Mapping[str, AnyArray], result: RunResult) -> tuple[IntArray, str | None]:
    """Index in ``stages`` of each rollout's stage ``[N]``; or that a stage is not reported."""
    known = {(one.repetition, one.stage): index for index, one in enumerate(result.stages)}
    pairs = np.stack([columns["repetition"], columns["stage"]], axis=1)
    begins = np.flatnonzero(np.r_[True, np.any(pairs[1:] != pairs[:-1], axis=1)][: len(pairs)])
    place = np.empty(len(pairs), dtype=np.int64)
    for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(pairs)], strict=True):
        repetition, stage = pairs[begin].tolist()
        if (repetition, stage) not in known:
            words = f"stages: {ROLLOUTS_FILE} holds repetition {repetition}, stage {stage} besides"
            return place, words
        place[begin:end] = known[repetition, stage]
    return place, None


def _stage_counts(violated: BoolArray, place: IntArray, result: RunResult) -> Iterator[str]:
    """Rollouts and failures of stages; one of which some are kept may have more."""
    kept = np.bincount(place, minlength=len(result.stages)).tolist()
    failing = np.bincount(place[violated], minlength=len(result.stages)).tolist()
    for index, stage in enumerate(result.stages):
        name = f"stages[{index}]"
        some = result.config.keep != "all" and kept[index] < stage.rollouts
        if not some and kept[index] != stage.rollouts:
            yield f"{name}.rollouts = {stage.rollouts}: {ROLLOUTS_FILE} holds {kept[index]}"
        more_is_known = some and stage.kind != "final" and failing[index] < stage.failures
        if failing[index] != stage.failures and not more_is_known:
            yield f"{name}.failures = {stage.failures}: {ROLLOUTS_FILE} holds {failing[index]}"


def _kept_repetitions(
    arrays: Mapping[str, AnyArray], place: IntArray, result: RunResult
) -> tuple[list[KeptRepetition], list[Mapping[str, BoolArray]]]:
    """The violating rollouts of each repetition, and which rules each of them breaks."""
    every = np.flatnonzero(arrays["violated"])
    log_weight, log_p = _likelihoods(arrays, every)
    columns, broken = (
        {n.removeprefix(prefix): arrays[n][every] for n in arrays if n.startswith(prefix)}
        for prefix in (COLUMN, BROKEN)
    )
    stage_of = place[every]
    repetition_of = np.array([one.repetition for one in result.stages], dtype=np.int64)[stage_of]
    kept: list[KeptRepetition] = []
    rules: list[Mapping[str, BoolArray]] = []
    for repetition, estimate in enumerate(result.repetitions):
        rows = np.flatnonzero(repetition_of == repetition)
        numbers = [n for n, one in enumerate(result.stages) if one.repetition == repetition]
        stages = [result.stages[number] for number in numbers]
        kept.append(
            KeptRepetition(
                method=estimate.method,
                stages=[
                    KeptStage(one.kind, one.rollouts, one.failures, log_of(one.log10_probability))
                    for one in stages
                ],
                stage=np.searchsorted(numbers, stage_of[rows]),
                log_weight=log_weight[rows],
                log_p=log_p[rows],
                columns={name: values[rows] for name, values in columns.items()},
            )
        )
        rules.append({name: values[rows] for name, values in broken.items()})
    return kept, rules


def _likelihoods(arrays: Mapping[str, AnyArray], rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Log weights and log likelihoods of some rollouts, a few at a time; finite numbers."""
    names = ["detected", "log_p", "log_q", *(name for name in arrays if name.startswith(LATENTS))]
    log_weight, log_p = np.empty(rows.size), np.empty(rows.size)
    for begin in range(0, rows.size, AT_ONCE):
        part = slice(begin, begin + AT_ONCE)
        some = {name: np.array(arrays[name][rows[part]], order="C") for name in names}
        log_weight[part] = log_weights(some)
        log_p[part] = row_sums(some["log_p"])
    if not (np.isfinite(log_weight).all() and np.isfinite(log_p).all()):
        raise ValueError("log_p and log_q must be finite numbers")
    return log_weight, log_p
