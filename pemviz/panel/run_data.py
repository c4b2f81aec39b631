"""A run as the panel shows it, be it under way, just finished or read from a folder."""

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, row_sums
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.latents import Latents
from pemviz.panel.scans import Report, Scans, row_parts
from pemviz.panel.tables import checked_rows, latent_names
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import latents_of, log_weights
from pemviz.runs.specification import asked_signals
from pemviz.sampling.registry import by_name
from pemviz.simulators.braking.scenario import GAP, scenario_signals
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Signal, Simulator, StageKind

Value = TypeVar("Value")

CLEARANCE = "clearance"
"""Signal of scenarios with several cars: how far the ego is from the nearest [m]."""


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
        simulated: How many rollouts were simulated; tables may hold fewer, see
            :func:`pemviz.panel.tables.thinned`.
        folder: Where the run lies on disk, if it does.
        running: Whether it goes on.
        own: The scenario, in its own steps, if it is another than the braking scenario.
        mapped: Whether the tables' arrays of steps lie on disk, unchecked; :meth:`steps` reads.
        curves_from: How many rollouts of a stage its curve is the mean of, where that is not all.
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
    mapped: bool = False
    curves_from: int | None = None
    memo: Memo = field(default_factory=Memo, init=False)
    scans: Scans = field(default_factory=Scans, init=False)

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

    def steps(self, names: Iterable[str], rows: int | slice | IntArray) -> dict[str, AnyArray]:
        """Rows ``[R, ...]`` of the tables' arrays; of one rollout ``[1, ...]``.

        Raises:
            InputError: They lie on disk, and hold numbers that cannot be a run's.
        """
        chosen = slice(rows, rows + 1) if isinstance(rows, int) else rows
        if self.mapped:
            return checked_rows(self.rollouts, names, chosen, where=str(self.folder))
        return {name: self.rollouts[name][chosen] for name in names}

    def signals(self, rows: int | slice | IntArray) -> dict[str, FloatArray]:
        """Signals ``[R, T]`` of rollouts by the names that specifications use.

        Raises:
            InputError: As :meth:`steps`.
        """
        keys = {signal.name: signal.key for signal in self.simulator.signals}
        found = self.steps(keys.values(), rows)
        return {name: np.asarray(found[key], dtype=np.float64) for name, key in keys.items()}

    def latents(self, rows: int | slice | IntArray) -> Latents | None:
        """Latents of rollouts; ``None`` if there are none.

        Raises:
            InputError: They lie on disk, and are no finite numbers.
        """
        names = latent_names(self.rollouts) if self.parts else ()
        try:
            return latents_of(self.steps(names, rows)) if names else None
        except ValueError as error:
            message = f"rollouts {self.folder}: {error}"
            raise InputError(message) from error

    @property
    def log_weight(self) -> FloatArray:
        """Log importance weights ``[N]`` of the rollouts kept [nats].

        Raises:
            InputError: As :meth:`steps`.
        """
        return self.scans.value("log weight", self._log_weight)

    def weigh(self) -> None:
        """Have log weights computed, if there are rollouts: what follows needs no wait.

        Raises:
            InputError: As :meth:`steps`.
        """
        if self.parts:
            _ = self.log_weight

    def _log_weight(self, report: Report) -> FloatArray:
        if not self.mapped:
            return log_weights(self.rollouts)
        if by_name(self.config.method).follows_model:  # drawn from the error model itself
            return np.zeros(self.kept)
        names = {"log_p", "log_q", *latent_names(self.rollouts)}
        found = np.empty(self.kept)
        for rows in row_parts(self.kept):
            try:
                found[rows] = log_weights(self.steps(names, rows))
            except ValueError as error:
                message = f"rollouts {self.folder}: {error}"
                raise InputError(message) from error
            report(rows.stop)
        return found

    def pem_nll(self, rows: slice | IntArray) -> FloatArray:
        """Negative log-likelihoods ``[R]`` of rollouts under the error model [nats]."""
        return -row_sums(np.asarray(self.steps(["log_p"], rows)["log_p"], dtype=np.float64))


def detection_probability(log_likelihood: FloatArray, detected: BoolArray) -> FloatArray:
    """P(detected) ``[...]`` from the log likelihood of outcomes ``[...]``."""
    return np.where(detected, np.exp(log_likelihood), -np.expm1(log_likelihood))


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
