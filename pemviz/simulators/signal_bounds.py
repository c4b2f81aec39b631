"""How far signals can go from a state on, and how far they go at least, whatever is reported."""

from collections.abc import Mapping
from typing import Protocol, TypeAlias, runtime_checkable

from pemviz.arrays import FloatArray
from pemviz.simulators.latents import WrappedSimulator
from pemviz.types import Simulator, StateBatch

SignalBounds: TypeAlias = Mapping[str, tuple[FloatArray | float, FloatArray | float]]
"""Lowest and highest value by signal, ``[N]`` or one for all."""


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
