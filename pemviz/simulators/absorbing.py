"""What is known of violations at a state: whether there has been one, can be or must be one."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.latents import LatentCounts
from pemviz.simulators.latents import begun, latent_counts, salient_of, stepped
from pemviz.types import Signal, Simulator, StateBatch

VIOLATED = "violated"
SignalBounds: TypeAlias = Mapping[str, tuple[FloatArray | float, FloatArray | float]]
"""Lowest and highest value by signal, ``[N]`` or one for all."""


def violated_rule(rule: str) -> str:
    """The memory that says whether a rollout has broken one of several rules."""
    return f"{VIOLATED} {rule}"


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


@dataclass(frozen=True)
class AbsorbingSimulator(WrappedSimulator):
    """Remembers violations where single states decide them, as ``violated`` in the memory.

    A proposal that makes violations likely must know when there has been one: from then on
    nothing is to be gained, and leaving the error model only spreads the weights.

    Attributes:
        unsafe: States ``[N]`` to whether being in them is a violation.
    """

    unsafe: Callable[[StateBatch], BoolArray]

    def salient_at(self, states: StateBatch) -> FloatArray:
        """The back end's salient variables at states."""
        return salient_of(self.scenario, states)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The back end's initial states and whether they violate."""
        states = begun(self.scenario, count=count, start=start)
        return self._absorbed(states, np.zeros(count, dtype=np.bool_))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The back end's next states; a violation stays."""
        after = stepped(self.scenario, states, detected, noise)
        return self._absorbed(after, states.memory[VIOLATED])

    def _absorbed(self, states: StateBatch, before: BoolArray) -> StateBatch:
        return replace(states, memory={**states.memory, VIOLATED: before | self.unsafe(states)})


class Monitor(Protocol):
    """Follows rollouts state by state, and tells which have violated whatever comes next."""

    def start(self, *, count: int) -> Any:
        """What is known of ``count`` rollouts before their first state."""
        ...

    def advance(self, known: Any, *, step: int, signals: Mapping[str, FloatArray]) -> Any:
        """What is known with the states of ``step`` too, signals ``[N]``; changes nothing."""
        ...

    def violated(self, known: Any) -> BoolArray:
        """Which rollouts violate the specification for certain, ``[N]``."""
        ...


@dataclass(frozen=True)
class EachRule:
    """A monitor of several rules, violated once all are broken, that tells of each.

    Attributes:
        monitors: By the rules' names; at least one.
    """

    monitors: Mapping[str, Monitor]

    def start(self, *, count: int) -> Mapping[str, Any]:
        """What is known of ``count`` rollouts before their first state, by rule."""
        return {rule: one.start(count=count) for rule, one in self.monitors.items()}

    def advance(
        self, known: Mapping[str, Any], *, step: int, signals: Mapping[str, FloatArray]
    ) -> Mapping[str, Any]:
        """What is known with the states of ``step`` too, signals ``[N]``, by rule."""
        return {
            rule: one.advance(known[rule], step=step, signals=signals)
            for rule, one in self.monitors.items()
        }

    def violated(self, known: Mapping[str, Any]) -> BoolArray:
        """Which rollouts break every rule for certain, ``[N]``."""
        return np.all(list(self.broken(known).values()), axis=0)

    def broken(self, known: Mapping[str, Any]) -> Mapping[str, BoolArray]:
        """Which break each rule for certain, ``[N]`` by the memory's name."""
        return {
            violated_rule(rule): one.violated(known[rule]) for rule, one in self.monitors.items()
        }


@dataclass(frozen=True)
class MonitoredStates(StateBatch):
    """States together with what the monitor knows of the way that led to them.

    Attributes:
        known: By the monitor.
        own: The back end's states; ``None``: these are.
    """

    known: Any = None
    own: StateBatch | None = None


@dataclass(frozen=True)
class MonitoredSimulator(WrappedSimulator):
    """Remembers violations, likewise, where it takes a monitor of the states so far to tell them.

    Of several rules it also remembers each (:class:`EachRule`).

    Its states continue rollouts that it began itself.

    Attributes:
        monitor: What tells them.
    """

    monitor: Monitor

    def salient_at(self, states: StateBatch) -> FloatArray:
        """The back end's salient variables at states."""
        return salient_of(self.scenario, _own(states))

    def initial(self, *, count: int, start: FloatArray | None = None) -> MonitoredStates:
        """The back end's initial states and whether they violate."""
        states = begun(self.scenario, count=count, start=start)
        return self._monitored(states, self.monitor.start(count=count))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> MonitoredStates:
        """The back end's next states; a violation stays.

        Raises:
            TypeError: The states are not this simulator's own.
        """
        if not isinstance(states, MonitoredStates):
            message = "a monitored simulator goes on from its own states only"
            raise TypeError(message)
        after = stepped(self.scenario, _own(states), detected, noise)
        return self._monitored(after, states.known)

    def _monitored(self, states: StateBatch, before: Any) -> MonitoredStates:
        verdict = self.monitor.advance(before, step=int(states.step), signals=states.signals)
        each = self.monitor.broken(verdict) if isinstance(self.monitor, EachRule) else {}
        return MonitoredStates(
            step=states.step,
            signals=states.signals,
            memory={**states.memory, **each, VIOLATED: self.monitor.violated(verdict)},
            known=verdict,
            own=states,
        )


def _own(states: StateBatch) -> StateBatch:
    """The back end's states in monitored ones."""
    own = states.own if isinstance(states, MonitoredStates) else None
    return states if own is None else own


@runtime_checkable
class BoundsSignals(Protocol):
    """A simulator that says how far its signals can go, whatever perception reports.

    States from which no rule can be broken any more then need not be followed to the end. A class
    answers for its own ``step`` alone: one that inherits the method does not count.
    """

    def signal_bounds(self, states: StateBatch, *, steps: int) -> SignalBounds:
        """Between which values signals stay, from states ``[N]`` to ``steps`` steps later.

        True of every sequence of outcomes, and of rounding; a signal that is left out may take
        any value.
        """
        ...


@runtime_checkable
class TellsReached(Protocol):
    """A simulator that says how far its signals go at least.

    States from which a rule is broken whatever follows need not be followed at all. A class answers
    for its own ``step`` alone: one that inherits the method does not count.
    """

    def signals_reached(self, states: StateBatch, *, steps: int) -> SignalBounds:
        """What signals reach at some of the next ``steps`` states, from states ``[N]``.

        True of every sequence of outcomes, and of rounding: at one of those states the signal is
        at most the first, at one at least the second; a signal that is left out may stay.
        """
        ...


def tells_bounds(simulator: Simulator) -> bool:
    """Whether a simulator, or what it wraps, bounds its signals."""
    return isinstance(_telling(simulator, "signal_bounds"), BoundsSignals)


def tells_reached(simulator: Simulator) -> bool:
    """Whether a simulator, or what it wraps, says what its signals reach."""
    return isinstance(_telling(simulator, "signals_reached"), TellsReached)


def signal_bounds(simulator: Simulator, states: StateBatch, *, steps: int) -> SignalBounds:
    """As :meth:`BoundsSignals.signal_bounds`, of what a simulator wraps; empty if none tells."""
    telling = _telling(simulator, "signal_bounds")
    return telling.signal_bounds(states, steps=steps) if isinstance(telling, BoundsSignals) else {}


def signals_reached(simulator: Simulator, states: StateBatch, *, steps: int) -> SignalBounds:
    """As :meth:`TellsReached.signals_reached`, of what a simulator wraps; empty if none tells."""
    telling = _telling(simulator, "signals_reached")
    return telling.signals_reached(states, steps=steps) if isinstance(telling, TellsReached) else {}


def _telling(simulator: Simulator, method: str) -> Simulator | None:
    """The simulator within all wrappers, if its own class has the method."""
    while isinstance(simulator, WrappedSimulator):
        simulator = simulator.scenario
    return simulator if method in vars(type(simulator)) else None
