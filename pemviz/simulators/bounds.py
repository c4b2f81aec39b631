"""How far signals can go from a state on, whatever perception reports."""

from collections.abc import Mapping
from typing import Protocol, TypeAlias, runtime_checkable

from pemviz.arrays import FloatArray
from pemviz.simulators.latched import WrappedSimulator
from pemviz.types import Simulator, StateBatch

SignalBounds: TypeAlias = Mapping[str, tuple[FloatArray | float, FloatArray | float]]
"""Lowest and highest value by signal, ``[N]`` or one for all."""


@runtime_checkable
class BoundsSignals(Protocol):
    """A simulator that says how far its signals can go.

    States from which no rule can be broken any more then need not be followed to the end. A class
    answers for its own ``step`` alone: one that inherits the method is not asked.
    """

    def signal_bounds(self, states: StateBatch, *, steps: int) -> SignalBounds:
        """Between which values signals stay, from states ``[N]`` to ``steps`` steps later.

        True of every sequence of outcomes, and of rounding; a signal that is left out may take
        any value.
        """
        ...


def tells_bounds(simulator: Simulator) -> bool:
    """Whether a simulator, or what it wraps, bounds its signals."""
    return _telling(simulator) is not None


def signal_bounds(simulator: Simulator, states: StateBatch, *, steps: int) -> SignalBounds:
    """As :meth:`BoundsSignals.signal_bounds`, of what a simulator wraps; empty if none tells."""
    telling = _telling(simulator)
    return {} if telling is None else telling.signal_bounds(states, steps=steps)


def _telling(simulator: Simulator) -> BoundsSignals | None:
    scenario = simulator
    while isinstance(scenario, WrappedSimulator):
        scenario = scenario.scenario
    own = "signal_bounds" in vars(type(scenario))
    return scenario if own and isinstance(scenario, BoundsSignals) else None
