"""Scenarios with latents, those without, and what wraps them: begun and stepped the same way."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.faults import SimulationError, blame
from pemviz.heartbeat import beat
from pemviz.latents import NO_LATENTS, LatentCounts
from pemviz.types import Signal, Simulator, SimulatorFacts, StateBatch

Part = TypeVar("Part")
Value = TypeVar("Value")
HOLDING = ("scenario", "example", "environment", "env")
"""Attributes in which a system has what it is made of."""


@runtime_checkable
class LatentSimulator(SimulatorFacts, Protocol):
    """A scenario that takes standard normals at the start, at every step, or both.

    Like :class:`pemviz.types.Simulator`, or like one with slots, but for what its counts add:
    with ``start`` S above 0 ``initial(count, start)`` is given standard normals ``[N, S]``, those
    of ``seeds`` after them, and with ``noise`` M above 0 ``step(states, detected, noise)`` is given
    those of the step, ``[N, M]``. Both stay pure: all that is random about a rollout is in them and
    in the outcomes.
    """

    @property
    def latents(self) -> LatentCounts:
        """How many."""
        ...

    def initial(self, *args: Any, **kwargs: Any) -> StateBatch:
        """``initial(*, count)`` or ``initial(*, count, start)``."""
        ...

    def step(self, *args: Any, **kwargs: Any) -> StateBatch:
        """``step(states, detected)`` or ``step(states, detected, noise)``."""
        ...


@runtime_checkable
class NamesStarts(Protocol):
    """A scenario with latents at the start that says what they mean.

    Any :class:`pemviz.Simulator` may offer it. Results then tell how the starts of violations
    differ from all starts; `within` finds it inside of what wraps the scenario.
    """

    @property
    def starts(self) -> tuple[Signal, ...]:
        """The start values, in the order in which to show them; bounds are those of axes."""
        ...

    @property
    def start_plane(self) -> tuple[str, str]:
        """Names of two of them, across and up, that together tell most of the danger."""
        ...

    def start_values(self, start: FloatArray) -> Mapping[str, FloatArray]:
        """Latents ``[N, S]`` to the start values by name, ``[N]`` each.

        They may be derived ones too, such as a closing speed.
        """
        ...


@dataclass(frozen=True)
class WrappedSimulator:
    """The same scenario, of whose states something more is known.

    Attributes:
        scenario: The back end itself.
    """

    scenario: Simulator

    @property
    def name(self) -> str:
        """The back end's name."""
        return self.scenario.name

    @property
    def states(self) -> int:
        """States in a rollout."""
        return self.scenario.states

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.scenario.dt_s

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The back end's signals."""
        return self.scenario.signals

    @property
    def latents(self) -> LatentCounts:
        """The back end's latents."""
        return latent_counts(self.scenario)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The back end's salient variables."""
        return self.scenario.salient(signals)


def within(simulator: object, kind: type[Part]) -> Part | None:
    """The part of a kind, at or beneath what wraps it as its ``scenario``; ``None``: there is none.

    The kind is a class, or a protocol that can be checked.
    """
    part: object = simulator
    while part is not None and not isinstance(part, kind):
        part = getattr(part, "scenario", None)
    return part


def parts_of(simulator: object) -> Iterator[Any]:
    """A simulator and what it is made of: what wrappers wrap, episodes and adapters hold."""
    part, seen = simulator, list[object]()
    while part is not None and not any(part is one for one in seen):
        yield part
        seen.append(part)
        inner = (getattr(part, name, None) for name in HOLDING)
        part = next((one for one in inner if one is not None), None)


def latent_counts(simulator: object) -> LatentCounts:
    """How many latents a simulator takes; none where it does not say."""
    return getattr(simulator, "latents", NO_LATENTS)


def begun(
    simulator: Simulator | LatentSimulator, *, count: int, start: FloatArray | None = None
) -> StateBatch:
    """The states in which ``count`` rollouts start.

    Latents ``start [N, S]`` are left out where the scenario takes none; ``None``: all 0, the
    median.

    Raises:
        SimulationError: The scenario raises something.
    """
    latents = latent_counts(simulator).at_start
    scenario: Any = simulator
    beat()
    try:
        if latents == 0:
            return _states(scenario, scenario.initial(count=count), count)
        given = np.zeros((count, latents)) if start is None else start
        return _states(scenario, scenario.initial(count=count, start=given), count)
    except BaseException as error:  # theirs may raise anything
        what = f"simulator {simulator.name}: initial"
        blame(error, what, step=0, rollouts=range(count), breaks=True)


def stepped(
    simulator: Simulator | LatentSimulator,
    states: StateBatch,
    detected: BoolArray,
    noise: FloatArray | None = None,
) -> StateBatch:
    """The next states after outcomes ``[N]``, or as the scenario has its outcomes.

    Latents of the step ``noise [N, M]`` are left out where it takes none; ``None``: all 0.

    Raises:
        SimulationError: The scenario raises something.
    """
    beat()
    latents = latent_counts(simulator).noise
    scenario: Any = simulator

    def step() -> StateBatch:
        if latents == 0:
            return _states(scenario, scenario.step(states, detected), len(detected), states)
        given = np.zeros((len(detected), latents)) if noise is None else noise
        return _states(scenario, scenario.step(states, detected, given), len(detected), states)

    return _evaluated(simulator, "step", states, step)


def salient_of(simulator: Simulator, states: StateBatch) -> FloatArray:
    """What perception depends on at a simulator's own states: salient variables ``[N, D]``.

    They come of the signals, or of the simulator's ``salient_at(states)`` if it has one: where
    states already know what their signals would tell.

    Raises:
        SimulationError: The simulator raises something.
    """
    at_states = getattr(simulator, "salient_at", None)
    if at_states is not None:
        return _evaluated(simulator, "salient", states, lambda: at_states(states))
    return _evaluated(simulator, "salient", states, lambda: simulator.salient(states.signals))


def _states(simulator: Any, given: Any, count: int, before: StateBatch | None = None) -> StateBatch:
    if not isinstance(given, StateBatch):
        what = f"simulator {simulator.name} gives a {type(given).__name__}"
        raise SimulationError(what, why="must be a pemviz.StateBatch")
    for name, values in given.signals.items():
        if np.shape(values)[:1] != (count,):
            what = f"simulator {simulator.name}: {name} has shape {np.shape(values)}"
            step = None if before is None else _step(simulator, before, further=1)
            raise SimulationError(what, why=f"must be ({count},)", step=step)
    return given


def _step(simulator: Any, states: StateBatch, *, further: int = 0) -> int | None:
    """The scenario's own step; states count turns where it takes turns."""
    turns, part = 1, simulator
    while (inner := getattr(part, "scenario", None)) is not None:
        turns, part = getattr(part, "turns", turns), inner
    return (int(states.step) + further) // turns if np.ndim(states.step) == 0 else None


def _evaluated(simulator: Any, what: str, states: StateBatch, call: Callable[[], Value]) -> Value:
    try:
        return call()
    except BaseException as error:  # as above
        step = _step(simulator, states)
        rollouts = range(len(next(iter(states.signals.values()))))
        what = f"simulator {simulator.name}: {what}"
        blame(error, what, step=step, rollouts=rollouts, breaks=True)
