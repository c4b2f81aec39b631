"""One rollout of a kept run, by its rank."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.config import ScenarioConfig
from pemviz.config.ranges import shown
from pemviz.errors import InputError
from pemviz.runs.observers import Rollout
from pemviz.runs.ranking import ranked_rows
from pemviz.runs.reading import read_whole_run
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import BROKEN, LATENTS, ROLLOUT, load_rollouts

PER_ROLLOUT = ("repetition", "stage", "robustness", "violated")
PER_OUTCOME = ("detected", "log_p", "log_q")
RUN_TIME = "%Y%m%d-%H%M%S"
RUN_TIME_LENGTH = len("20260101-120000")
UNDATED = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class KeptRollout:
    """A rollout of a run with what is needed to tell about it.

    Attributes:
        result: Of the run.
        rank: From 1, as :func:`pemviz.runs.ranking.ranked_rows` ranks.
        repetition: Zero-based.
        stage: Its stage.
        rollout: Its index in the stage.
        robustness: Under the run's metric.
        violated: Whether the formula fails, see :func:`pemviz.stl.violated`.
        broken: Whether it breaks each rule, by name, where there are rules.
        signals: ``[T]`` by key, with units in it (``gap_m``).
        detected: ``[T-1]`` outcomes by slot; where perception answers one thing a step under the
            one name ``""``.
        log_p: ``[T-1]`` log likelihood of the outcomes under the error model [nats], likewise.
        log_q: ``[T-1]`` the same under the distribution that they were sampled from [nats].
        latents: Of a scenario that takes some: ``start``, the means ``start_mean`` that it was
            sampled with ``[S]``, ``start_log_weight`` ``[]``, ``noise``, ``noise_mean``,
            ``noise_sd`` and ``noise_narrow_mean`` ``[T-1, M]``, ``noise_share`` and
            ``noise_narrow_share`` ``[T-1]``.
    """

    result: RunResult
    rank: int
    repetition: int
    stage: int
    rollout: int
    robustness: float
    violated: bool
    broken: Mapping[str, bool]
    signals: Mapping[str, FloatArray]
    detected: Mapping[str, BoolArray]
    log_p: Mapping[str, FloatArray]
    log_q: Mapping[str, FloatArray]
    latents: Mapping[str, FloatArray]

    @property
    def states(self) -> int:
        """States T."""
        return next(iter(self.detected.values())).size + 1

    @property
    def scenario(self) -> ScenarioConfig | None:
        """The shipped scenario's parameters; ``None``: it was another simulator."""
        config = self.result.config
        return config.scenario if config.is_braking_scenario else None

    @property
    def date(self) -> datetime:
        """When its run began, as its id says; 1 January 1970 if the id says nothing."""
        try:
            began = datetime.strptime(self.result.run_id[:RUN_TIME_LENGTH], RUN_TIME)
        except ValueError:
            return UNDATED
        return began.replace(tzinfo=UTC)


def read_kept_rollout(folder: Path, *, rank: int) -> KeptRollout:
    """The rollout with a rank, from 1, of a run folder, be the run done or not.

    Raises:
        InputError: There is no such rollout, or something in the folder is damaged.
    """
    if not folder.is_dir():
        message = f"run {folder}: there is no such folder"
        raise InputError(message)
    result = read_whole_run(folder)
    table = load_rollouts(folder)
    _check(table, where=folder)
    try:
        order = ranked_rows(table, result.stages)
    except ValueError as error:
        message = f"rollouts {folder}: {error}"
        raise InputError(message) from error
    whole = isinstance(rank, int | np.integer)  # pyright: ignore[reportUnnecessaryIsInstance]
    if not (whole and 1 <= rank <= order.size):
        allowed = f"must be a whole number from 1 to {order.size}, the rollouts kept in {folder}"
        message = f"rank = {shown(rank)}: {allowed}"
        raise InputError(message)
    return _chosen(table, int(order[rank - 1]), result=result, rank=rank)


def read_rollout(folder: Path | str, *, rank: int = 1) -> Rollout:
    """A rollout that a run folder keeps, as a notebook shows it; rank 1 is the least robust.

    Signals have the names of files, with units (``gap_m``), as :func:`pemviz.read_result` does not
    need the simulator.

    Args:
        folder: The run folder.
        rank: From 1, as the summary, ``pemviz export`` and the panel rank.

    Raises:
        InputError: As :func:`read_kept_rollout`.
    """
    found = read_kept_rollout(Path(folder), rank=rank)
    own, config = found.result.simulator, found.result.config
    explained = () if found.result.explanation is None else found.result.explanation.slots
    false_positives = {slot.name for slot in explained if not slot.nominal}
    right = {name: bits != (name in false_positives) for name, bits in found.detected.items()}
    log_p = np.sum(list(found.log_p.values()), dtype=np.float64)
    dt_s = config.dt_s if own is None else own.dt_s
    rollout = Rollout(
        repetition=found.repetition,
        stage=found.stage,
        robustness=found.robustness,
        violated=found.violated,
        nll=-float(log_p),
        time_s=np.arange(found.states, dtype=np.float64) * dt_s,
        signals=found.signals,
        detected=np.logical_and.reduce(list(right.values())),
        right_by_slot={} if set(right) == {""} else right,
        rank=rank,
    )
    latents = {name: found.latents[name] for name in ("start", "noise") if name in found.latents}
    return replace(rollout, **latents)


def _chosen(
    table: Mapping[str, AnyArray], row: int, *, result: RunResult, rank: int
) -> KeptRollout:
    one = {name: values[row] for name, values in table.items()}
    of_stage = (table["repetition"] == one["repetition"]) & (table["stage"] == one["stage"])
    slots = _slot_names(result, one["detected"])
    detected, log_p, log_q = (
        dict(zip(slots, one[name].reshape(-1, len(slots)).T, strict=True)) for name in PER_OUTCOME
    )
    beside = (*PER_ROLLOUT, ROLLOUT, *PER_OUTCOME)
    signals = [n for n in table if n not in beside and not n.startswith((BROKEN, LATENTS))]
    return KeptRollout(
        result=result,
        rank=rank,
        repetition=int(one["repetition"]),
        stage=int(one["stage"]),
        rollout=int(one.get(ROLLOUT, np.count_nonzero(of_stage[:row]))),
        robustness=float(one["robustness"]),
        violated=bool(one["violated"]),
        broken={n.removeprefix(BROKEN): bool(v) for n, v in one.items() if n.startswith(BROKEN)},
        signals={name: one[name].astype(np.float64) for name in signals},
        detected=detected,
        log_p=log_p,
        log_q=log_q,
        latents={n.removeprefix(LATENTS): v for n, v in one.items() if n.startswith(LATENTS)},
    )


def _slot_names(result: RunResult, detected: AnyArray) -> tuple[str, ...]:
    """The slots' names as the run's explanation has them; their numbers, if it does not."""
    if detected.ndim == 1:
        return ("",)
    count = detected.shape[1]
    explained = () if result.explanation is None else result.explanation.slots
    names = tuple(slot.name for slot in explained)
    return names if len(set(names)) == count else tuple(str(slot) for slot in range(count))


def _check(table: Mapping[str, AnyArray], *, where: Path) -> None:
    """Check that the arrays are those of N rollouts of T states."""
    absent = [name for name in (*PER_ROLLOUT, *PER_OUTCOME) if name not in table]
    if absent:
        message = f"rollouts {where}: {absent[0]} is absent"
        raise InputError(message)
    outcomes = table["detected"].shape
    if len(outcomes) not in (2, 3) or 0 in outcomes[1:]:
        message = (
            f"rollouts {where}: detected has shape {outcomes}, must be [N, T-1] or [N, T-1, K]"
        )
        raise InputError(message)
    count, steps = outcomes[:2]
    for name, values in table.items():
        if name.startswith(LATENTS):
            continue
        shape = (count, steps + 1)
        if name in PER_OUTCOME:
            shape = outcomes
        elif name in (*PER_ROLLOUT, ROLLOUT) or name.startswith(BROKEN):
            shape = (count,)
        if values.shape != shape:
            message = f"rollouts {where}: {name} has shape {values.shape}, must have {shape}"
            raise InputError(message)
    if np.isnan(table["robustness"]).any():
        message = f"rollouts {where}: robustness must hold numbers, not NaN"
        raise InputError(message)
