"""How near the compiled loop of plain rollouts comes to what this machine allows."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.simulators.braking.compiled import BLOCK, CompiledRollouts


@dataclass(frozen=True)
class LimitWork:
    """Two pieces of work, each a part of what the loop does for the same rollouts.

    Attributes:
        memory: Makes the arrays that the loop makes, writes them once and reads the draws once:
            what remains if arithmetic were free.
        arithmetic: The loop itself, a few rollouts at a time in arrays that stay in the
            processor's cache: what remains if memory were free.
    """

    memory: Callable[[], object]
    arithmetic: Callable[[], object]


def limit_work(rollouts: CompiledRollouts, uniforms: FloatArray) -> LimitWork:
    """The limits' work for ``uniforms [N, T-1]``, whose gaps ``rollouts`` has met before."""

    def memory() -> float:
        _, tracks = rollouts.begun(len(uniforms))
        for array in (tracks.gap_m, tracks.ego_mps, tracks.integral_m):
            array[1:] = 0.0
        tracks.logit[:] = 0.0
        tracks.detected[:] = False
        return float(np.add.reduce(uniforms, axis=None))

    _, tracks = rollouts.begun(BLOCK)

    every = np.arange(BLOCK)

    def arithmetic() -> None:
        for first in range(0, len(uniforms) - BLOCK + 1, BLOCK):
            tracks.reached[:] = 0
            rollouts.advance(tracks, uniforms[first : first + BLOCK], every)

    return LimitWork(memory, arithmetic)
