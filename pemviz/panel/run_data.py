"""A run as the panel shows it, be it under way, just finished or read from a folder."""

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.latents import Latents
from pemviz.panel.rollout_tables import checked_rows, latent_names
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import latents_of, log_weights
from pemviz.runs.specification import named_signals, robustness_unit
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.registry import by_name
from pemviz.simulators.braking.scenario import GAP, scenario_signals
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Signal, Simulator

Value = TypeVar("Value")
Report = Callable[[int], None]
"""Told after each part of how many rollouts have been looked at."""
Scan = Callable[[Report], Value]

PART_ROWS = 4096
"""Rollouts looked at in one go: some tens of megabytes."""
AT_ONCE = 20_000
"""As many rollouts are looked at before a person notices."""
CLEARANCE = "clearance"
"""Signal of scenarios with several cars: how far the ego is from the nearest [m]."""


@dataclass(frozen=True)
class ScanProgress:
    """How far a scan is: ``done`` of ``count`` rollouts."""

    done: int
    count: int


def row_parts(count: int) -> Iterator[slice]:
    """Rows ``0`` to ``count`` in parts of :data:`PART_ROWS`."""
    for first in range(0, count, PART_ROWS):
        yield slice(first, min(first + PART_ROWS, count))


class Scans:
    """Results of scans by key, each computed once; one scan runs at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._turn = threading.Lock()
        self._results: dict[object, Future[Any]] = {}
        self._done: dict[object, int] = {}

    def value(self, key: object, scan: Scan[Value]) -> Value:
        """The scan's result, waited for; what it raised is raised again."""
        begun, mine = self._begun(key)
        if mine:
            self._carry_out(key, begun, scan)
        return cast(Value, begun.result())

    def begin(self, key: object, scan: Scan[Any], *, count: int) -> ScanProgress | None:
        """Have the scan done on a thread of its own; ``None`` once it is, or has failed.

        A run of at most :data:`AT_ONCE` rollouts is left to :meth:`value`.
        """
        if count <= AT_ONCE:
            return None
        begun, mine = self._begun(key)
        if mine:
            threading.Thread(
                target=self._carry_out, args=(key, begun, scan), name="pemviz-scan", daemon=True
            ).start()
        return None if begun.done() else ScanProgress(self._done.get(key, 0), count)

    @property
    def under_way(self) -> bool:
        """Whether a scan that was begun has not come to its end."""
        with self._lock:
            return not all(found.done() for found in self._results.values())

    def _begun(self, key: object) -> tuple[Future[Any], bool]:
        """The scan's result to come, and whether it is the caller who carries it out."""
        with self._lock:
            found = self._results.get(key)
            if found is not None:
                return found, False
            self._results[key] = made = Future[Any]()
            return made, True

    def _carry_out(self, key: object, result: Future[Any], scan: Scan[Any]) -> None:
        def report(done: int) -> None:
            self._done[key] = done

        try:
            with self._turn:
                result.set_result(scan(report))
        except BaseException as error:
            result.set_exception(error)


@dataclass(frozen=True)
class ProposalCurve:
    """P(detected) ``[G]`` against the run's gaps under one stage's proposal; NaN where unknown."""

    repetition: int
    stage: int
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
        gap_m: ``[G]`` ascending gaps of the curves [m].
        pem_detection: ``[G]`` P(detected) under the error model.
        curves: Proposals in the order in which they were learned.
        parts: Tables of rollouts with the keys of ``rollouts.npz``, each table some stages.
        simulated: How many rollouts were simulated; tables may hold fewer, see
            :func:`pemviz.panel.rollout_tables.thinned`.
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
        """The result's."""
        return self.result.config

    @property
    def method(self) -> MethodDescription:
        """What gave the answer: of one that chooses another, that, once it has chosen."""
        method, estimate = by_name(self.config.method), self.result.estimate
        if estimate is None or method.most is None:
            return method
        return by_name(estimate.method)

    @cached_property
    def simulator(self) -> Simulator | SlotSimulator:
        """The scenario, in its own steps."""
        return VectorizedSimulator(self.config.scenario) if self.own is None else self.own

    @property
    def has_scene(self) -> bool:
        """Whether the scenario tells where its cars are."""
        return drawn_scene(self.simulator) is not None

    @property
    def law_words(self) -> str:
        """Under what the answer is a probability, which weights lead back to."""
        return "the scenario" if self.result.is_of_detector_itself else "the error model"

    @property
    def charted(self) -> Signal:
        """The signal that charts draw: the gap, elsewhere what the specification is about first."""
        if self.own is None:
            return next(signal for signal in self.simulator.signals if signal.name == GAP)
        return named_signals(self.config, self.own.signals)[0]

    @property
    def robustness_unit(self) -> str:
        """Of the metric that ranked the rollouts; empty if it has none."""
        return robustness_unit(self.config, self.simulator.signals)

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
        last = self.curves[-1].repetition if self.curves else 0
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

    def _log_weight(self, report: Report) -> FloatArray:
        if not self.mapped:
            return log_weights(self.rollouts)
        if self.method.follows_model:  # drawn from the error model itself
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


def detection_probability(log_likelihood: FloatArray, detected: BoolArray) -> FloatArray:
    """P(detected) ``[...]`` from the log likelihood of outcomes ``[...]``."""
    return np.where(detected, np.exp(log_likelihood), -np.expm1(log_likelihood))


def own_scenario(
    simulator: Simulator | SlotSimulator, config: ExperimentConfig
) -> Simulator | SlotSimulator | None:
    """The simulator itself, unless its rollouts look like the braking scenario's."""
    scenario = config.scenario
    drawn = {signal.name: signal.key for signal in scenario_signals(scenario)}
    offered = {signal.name: signal.key for signal in simulator.signals}
    same = offered == drawn and (simulator.states, simulator.dt_s) == (
        scenario.states,
        scenario.dt_s,
    )
    return None if same else simulator
