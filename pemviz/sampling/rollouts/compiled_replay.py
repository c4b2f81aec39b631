"""Rollouts of the braking scenario whose outcomes are given, by a compiled loop.

What comes out is what numpy gives, to the last bit, in a fifth of the time or less.
"""

from collections.abc import Mapping
from typing import TypeGuard

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.sampling.rollouts.kernels import Loops, are_loaded, compiled_loops, lead_speeds
from pemviz.simulators.braking import loops
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import Simulator

WORTH_LOADING = 40_000_000
"""Steps of rollouts, all together, for which loading the loop, about half a second, pays."""


def replayed(simulator: Simulator, detected: BoolArray) -> Mapping[str, FloatArray] | None:
    """Signals ``[N, T]`` for outcomes ``[N, T-1]``; ``None`` where numpy is to compute them."""
    if not is_plain(simulator) or not (are_loaded() or detected.size >= WORTH_LOADING):
        return None
    kernels = compiled_loops()
    return None if kernels is None else replay(simulator, detected, kernels)


def is_plain(simulator: Simulator) -> TypeGuard[VectorizedSimulator]:
    """Whether it is the scenario that the loops know: without tracker and position errors."""
    return (
        type(simulator) is VectorizedSimulator
        and simulator.errors is None
        and simulator.tracker is None
    )


def replay(
    simulator: VectorizedSimulator, detected: BoolArray, kernels: Loops
) -> Mapping[str, FloatArray]:
    """Signals ``[N, T]`` of rollouts with outcomes ``[N, T-1]``."""
    config, count = simulator.config, len(detected)
    signals = np.empty((3, simulator.states, count))
    gap_m, ego_mps, lead_mps = signals
    gap_m[0], ego_mps[0] = config.initial_gap_m, config.initial_speed_mps
    speeds_mps = lead_speeds(config)
    lead_mps[:] = speeds_mps[:, None]
    by_step = np.ascontiguousarray(detected.T)
    kernels.replay(gap_m, ego_mps, by_step, speeds_mps, loops.numbers_of(config))
    return {GAP: gap_m.T, EGO_SPEED: ego_mps.T, LEAD_SPEED: lead_mps.T}
