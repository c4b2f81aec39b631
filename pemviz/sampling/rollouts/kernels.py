"""The braking scenario's loops, compiled by numba where it is installed."""

import importlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from types import FunctionType
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.compiling import is_installed
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking import loops
from pemviz.simulators.braking.scenario import LEAD_SPEED
from pemviz.simulators.braking.vectorized import VectorizedSimulator

LOG = logging.getLogger(__name__)
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
    """The compiled functions; ``None`` without numba, or with one that fails here.

    What is compiled is kept on disk: beside the source, else in the user's cache folder, and
    where neither can be written to each process compiles for itself.
    """
    if not is_installed():
        return None
    try:
        numba = importlib.import_module("numba")
        try:
            return _translated(numba.njit(cache=True))
        except RuntimeError:  # no folder to keep it in
            return _translated(numba.njit)
    except Exception as error:  # an installation of others may raise anything
        LOG.warning("numba cannot be used (%s); numpy simulates", error)
        return None


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
