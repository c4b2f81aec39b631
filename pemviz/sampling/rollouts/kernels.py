"""The braking scenario's loops, compiled by numba where it is installed."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from types import FunctionType
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.compiling import with_numba
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking import loops
from pemviz.simulators.braking.scenario import LEAD_SPEED
from pemviz.simulators.braking.vectorized import VectorizedSimulator

KEPT_SCENARIOS = 8
"""Of which the lead car's speeds are remembered."""


@dataclass(frozen=True)
class Loops:
    """The functions of :mod:`pemviz.simulators.braking.loops`, compiled or not."""

    advance: Callable[..., None] = loops.advance
    insert: Callable[..., None] = loops.insert
    replay: Callable[..., None] = loops.replay


@cache
def compiled_loops() -> Loops | None:
    """The compiled functions; ``None`` without numba, or with one that fails here."""
    return with_numba(_translated)


def _translated(njit: Callable[[Any], Any]) -> Loops:
    """All functions by one compiler; what they call of their own module they call compiled."""
    called = {"moved": njit(loops.moved)}

    def translated(function: Any) -> Any:
        names = {**function.__globals__, **called}
        return njit(FunctionType(function.__code__, names, function.__name__))

    return Loops(*map(translated, (loops.advance, loops.insert, loops.replay)))


def are_loaded() -> bool:
    """Whether this process has the compiled functions, or knows that there are none."""
    return compiled_loops.cache_info().currsize > 0


@lru_cache(maxsize=KEPT_SCENARIOS)
def lead_speeds(config: ScenarioConfig) -> FloatArray:
    """The lead car's speeds ``[T]`` [m/s], which no outcome changes; not to be written to."""
    simulator = VectorizedSimulator(config)
    states, found = simulator.initial(count=1), np.empty(simulator.states)
    for step in range(simulator.states):
        found[step] = states.signals[LEAD_SPEED][0]
        states = simulator.step(states, np.ones(1, dtype=np.bool_))
    found.flags.writeable = False
    return found
