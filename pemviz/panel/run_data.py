"""A run as the panel shows it, be it under way, just finished or read from a folder."""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, row_sums
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.latents import Latents
from pemviz.runs.result import RunResult, StageSummary
from pemviz.runs.rollout_files import BROKEN, ROLLOUT, latents_of, log_weights
from pemviz.runs.slot_outcomes import slots_of
from pemviz.runs.specification import asked_signals
from pemviz.simulators.braking.scenario import GAP, scenario_signals
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.scene import drawn_scene
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Signal, Simulator, StageKind

Value = TypeVar("Value")

CLEARANCE = "clearance"
"""Signal of scenarios with several cars: how far the ego is from the nearest [m]."""
KEPT_ROLLOUTS = 20_000
FARTHEST = 1e9
"""Beyond any gap [m], speed [m/s] or log likelihood of a step [nats]."""
PER_ROLLOUT = ("repetition", "stage", "robustness", "violated")


@dataclass(frozen=True)
class ProposalCurve:
    """P(detected) against the gap under one stage's proposal.

    Attributes:
        repetition: Zero-based.
        stage: The stage whose rollouts it was learned from.
        kind: That stage's kind.
        gap_m: ``[G]`` ascending gaps [m].
        detection: ``[G]`` probabilities; NaN where nothing is known.
    """

    repetition: int
    stage: int
    kind: StageKind
    gap_m: FloatArray
    detection: FloatArray


class Memo:
    """Values computed once for a run; it goes when the run goes."""

    def __init__(self) -> None:
        self._values: dict[object, Any] = {}
        self._lock = threading.RLock()

    def get(self, key: object, compute: Callable[[], Value]) -> Value:
        """The value under ``key``, computed at the first call."""
        with self._lock:
            if key not in self._values:
                self._values[key] = compute()
            return cast(Value, self._values[key])


@dataclass(frozen=True, eq=False)
class RunData:
    """One state of one run; a run that goes on yields a new one after every stage.

    Attributes:
        result: What the run tells, as far as it has come.
        gap_m: ``[G]`` gaps of the error model's curve [m].
        pem_detection: ``[G]`` P(detected) under the error model.
        curves: Proposals in the order in which they were learned.
        parts: Tables of rollouts with the keys of ``rollouts.npz``, each table some stages.
        simulated: How many rollouts were simulated; tables may hold fewer, see ``thinned``.
        folder: Where the run lies on disk, if it does.
        running: Whether it goes on.
        own: The scenario, in its own steps, if it is another than the braking scenario.
    """

    result: RunResult
    gap_m: FloatArray
    pem_detection: FloatArray
    curves: tuple[ProposalCurve, ...] = ()
    parts: tuple[Mapping[str, AnyArray], ...] = ()
    simulated: int = 0
    folder: Path | None = None
    running: bool = False
    own: Simulator | SlotSimulator | None = None
    memo: Memo = field(default_factory=Memo, init=False)

    @property
    def name(self) -> str:
        """Its folder's, which somebody may have renamed or copied; its id if it has none."""
        return self.result.run_id if self.folder is None else self.folder.name

    @property
    def config(self) -> ExperimentConfig:
        """What was asked."""
        return self.result.config

    @cached_property
    def simulator(self) -> Simulator | SlotSimulator:
        """The scenario, in its own steps."""
        return VectorizedSimulator(self.config.scenario) if self.own is None else self.own

    @property
    def charted(self) -> Signal:
        """The signal that charts draw: the gap, elsewhere what the specification is about first."""
        if self.own is None:
            return next(signal for signal in self.simulator.signals if signal.name == GAP)
        return asked_signals(self.config, self.own.signals)[0]

    @property
    def distance(self) -> Signal | None:
        """The signal that tells how near the cars come, if there is one."""
        if self.own is None:
            return self.charted
        return next((signal for signal in self.own.signals if signal.name == CLEARANCE), None)

    @property
    def time_s(self) -> FloatArray:
        """Times ``[T]`` of the states of a rollout [s]."""
        return np.arange(self.simulator.states, dtype=np.float64) * self.simulator.dt_s

    @cached_property
    def rollouts(self) -> Mapping[str, AnyArray]:
        """All tables joined; empty if there is no rollout."""
        if len(self.parts) == 1:
            return self.parts[0]
        if not self.parts:
            return {}
        return {name: np.concatenate([part[name] for part in self.parts]) for name in self.parts[0]}

    @property
    def kept(self) -> int:
        """How many rollouts the tables hold."""
        return sum(int(part["violated"].shape[0]) for part in self.parts)

    @property
    def final_curves(self) -> tuple[ProposalCurve, ...]:
        """The curves of the last repetition that has any."""
        if not self.curves:
            return ()
        last = self.curves[-1].repetition
        return tuple(curve for curve in self.curves if curve.repetition == last)

    @cached_property
    def log_weight(self) -> FloatArray:
        """Log importance weights ``[N]`` of the rollouts kept [nats]."""
        return log_weights(self.rollouts)

    @cached_property
    def pem_nll(self) -> FloatArray:
        """Negative log-likelihoods ``[N]`` of the rollouts kept under the error model [nats]."""
        return -row_sums(np.asarray(self.rollouts["log_p"], dtype=np.float64))


def detection_probability(log_likelihood: FloatArray, detected: BoolArray) -> FloatArray:
    """P(detected) ``[...]`` from the log likelihood of outcomes ``[...]``."""
    return np.where(detected, np.exp(log_likelihood), -np.expm1(log_likelihood))


def signals_of(run: RunData) -> dict[str, FloatArray]:
    """The kept rollouts' signals ``[N, T]`` by the names that specifications use."""
    return {
        signal.name: np.asarray(run.rollouts[signal.key], dtype=np.float64)
        for signal in run.simulator.signals
    }


def latents_of_run(run: RunData) -> Latents | None:
    """The latents of the kept rollouts; ``None`` if there are none."""
    return run.memo.get("latents", lambda: latents_of(run.rollouts) if run.parts else None)


def thinned(
    parts: Sequence[Mapping[str, AnyArray]],
    *,
    stages: Sequence[StageSummary],
    limit: int = KEPT_ROLLOUTS,
) -> tuple[Mapping[str, AnyArray], ...]:
    """At most ``limit`` rollouts, in their order.

    If there are more: of the final stages' violations those of largest weight, up to half of
    what is kept, and beside them the least robust of all others.

    Args:
        parts: Tables of rollouts.
        stages: The run's stages, as far as it has come.
        limit: How many rollouts are kept.
    """
    if sum(part["violated"].shape[0] for part in parts) <= limit:
        return tuple(parts)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    violations = np.flatnonzero(final_violations(joined, stages=stages))
    log_weight = log_weights(joined)[violations]
    heavy = violations[np.argsort(-log_weight, kind="stable")[: limit // 2]]
    order = np.argsort(joined["robustness"], kind="stable")
    others = order[~np.isin(order, heavy)][: limit - heavy.size]
    chosen = np.sort(np.concatenate([heavy, others]))
    return ({name: values[chosen] for name, values in joined.items()},)


def final_violations(
    table: Mapping[str, AnyArray], *, stages: Sequence[StageSummary], rule: str | None = None
) -> BoolArray:
    """Which rollouts ``[N]`` of a table violate, or break a rule, and belong to a final stage."""
    chosen = np.zeros(table["violated"].shape, dtype=np.bool_)
    for stage in stages:
        if stage.kind == "final":
            chosen |= (table["repetition"] == stage.repetition) & (table["stage"] == stage.stage)
    return chosen & verdicts(table, rule=rule)


def verdicts(table: Mapping[str, AnyArray], *, rule: str | None) -> BoolArray:
    """Which rollouts ``[N]`` of a table violate the specification or, if given, break a rule."""
    return np.asarray(table["violated" if rule is None else f"{BROKEN}{rule}"], dtype=np.bool_)


def numbered(part: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """The table with each rollout's index in its stage under ``rollout``."""
    if ROLLOUT in part:
        return dict(part)
    key = part["repetition"].astype(np.int64) * (1 << 32) + part["stage"].astype(np.int64)
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    starts = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]])
    lengths = np.diff(np.r_[starts, key.size])
    index = np.empty(key.size, dtype=np.int64)
    index[order] = np.arange(key.size) - np.repeat(starts, lengths)
    return {**part, ROLLOUT: index}


def own_scenario(
    simulator: Simulator | SlotSimulator, config: ExperimentConfig
) -> Simulator | SlotSimulator | None:
    """The simulator itself, unless its rollouts look like the braking scenario's.

    Raises:
        InputError: They do not, and it does not tell where its cars are: there is nothing to draw.
    """
    scenario = config.scenario
    drawn = {signal.name: signal.key for signal in scenario_signals(scenario)}
    offered = {signal.name: signal.key for signal in simulator.signals}
    times = (simulator.states, simulator.dt_s)
    if offered == drawn and times == (scenario.states, scenario.dt_s):
        return None
    if drawn_scene(simulator) is None:
        message = (
            f"simulator = {config.simulator!r}: the panel draws a car behind another "
            f"({', '.join(drawn)}; scenario.states and dt_s), or a simulator that tells where its "
            "cars are (pemviz.DrawsScene); use pemviz record and pemviz open"
        )
        raise InputError(message)
    return simulator


def check_table(
    table: Mapping[str, AnyArray],
    config: ExperimentConfig,
    *,
    where: str,
    simulator: Simulator | SlotSimulator | None = None,
) -> None:
    """Check a table read from disk against what its configuration promises.

    Raises:
        InputError: An array is absent, or its shape, type or numbers cannot be a run's.
    """
    scenario = VectorizedSimulator(config.scenario) if simulator is None else simulator
    slots = len(slots_of(scenario))
    acted = (scenario.states - 1, slots) if slots > 1 else (scenario.states - 1,)
    shapes = {signal.key: (scenario.states,) for signal in scenario.signals}
    shapes |= dict.fromkeys(("detected", "log_p", "log_q"), acted)
    count = table["violated"].size if "violated" in table else 0
    broken = [f"{BROKEN}{rule.name}" for rule in config.rules]
    numbers = [ROLLOUT] if ROLLOUT in table else []
    for name in (*PER_ROLLOUT, *numbers, *broken, *shapes):
        shape = (count, *shapes.get(name, ()))
        if name not in table or table[name].shape != shape:
            state = "is absent" if name not in table else f"has shape {table[name].shape}"
            message = f"rollouts {where}: {name} {state}, must have shape {shape}"
            raise InputError(message)
        fault = _fault(name, table[name])
        if fault is not None:
            message = f"rollouts {where}: {name} {fault}"
            raise InputError(message)
    try:
        latents_of(table)
    except ValueError as error:
        message = f"rollouts {where}: {error}"
        raise InputError(message) from error


def _fault(name: str, values: AnyArray) -> str | None:
    """What is wrong with an array's type or numbers, in words; ``None`` if nothing is."""
    kind = "b" if name.startswith(BROKEN) else _KINDS.get(name, "f")
    if values.dtype.kind != kind:
        return f"holds {values.dtype}, must hold {_KIND_WORDS[kind]}"
    if kind == "i" and not np.all((values >= 0) & (values < 2**31)):
        return "must lie between 0 and 2147483647"
    if name in ("log_p", "log_q") and not np.all((values <= 0.0) & (values >= -FARTHEST)):
        return f"must hold logarithms of probabilities, {-FARTHEST:g} to 0"
    if name == "robustness" and np.any(np.isnan(values)):
        return "must hold numbers, not NaN"
    if name not in PER_ROLLOUT and kind == "f" and not np.all(np.abs(values) <= FARTHEST):
        return f"must hold numbers between {-FARTHEST:g} and {FARTHEST:g}"
    return None


_KINDS = {"detected": "b", "violated": "b", "repetition": "i", "stage": "i", ROLLOUT: "i"}
_KIND_WORDS = {"b": "truth values", "i": "whole numbers", "f": "floating-point numbers"}
