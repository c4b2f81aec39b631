"""What a proposal looks at in the turn of a car at the merge."""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.merge.facts import CARS
from pemviz.simulators.merge.scenario import MergeSimulator, own_signals
from pemviz.simulators.slots import UnrolledSimulator
from pemviz.types import StateBatch

OF_TRACK = 2
"""Its hits, and the steps since the last one."""


@dataclass(frozen=True)
class MergeFeatures:
    """Of the car whose turn it is gap, offset, closing speed and track; the ego's speed; the time.

    Attributes:
        unrolled: The simulator, unrolled.
        simulator: The simulator.
    """

    unrolled: UnrolledSimulator
    simulator: MergeSimulator

    def values(self, states: StateBatch) -> FloatArray:
        """Gap [m], offset [m], closing speed and ego speed [m/s], time [s], ``[..., 5]``.

        With a tracker two more: hits of the track, and steps since the last.
        """
        slot = self.unrolled.slot_of(states.signals)[..., None]
        gap_m, aside_m, speed_mps, _ = (
            np.take_along_axis(of_all, slot, axis=-1)[..., 0]
            for of_all in own_signals(states.signals)
        )
        ego_mps = states.signals["ego_speed"]
        time_s = np.asarray(states.step // len(CARS), dtype=np.float64) * self.simulator.dt_s
        columns: list[FloatArray] = [gap_m, aside_m, ego_mps - speed_mps, ego_mps]
        columns.append(np.zeros_like(gap_m) + time_s)
        tracker = self.simulator.tracker
        if tracker.window > 1 or tracker.coast_steps > 0:
            tracks = tracker.state(states.memory, slots=len(CARS))
            columns += [
                np.take_along_axis(one, slot, axis=-1)[..., 0]
                for one in tracker.numbers(tracks)[:OF_TRACK]
            ]
        return np.stack(columns, axis=-1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where a detection of the car may matter, ``[...]``."""
        return self.unrolled.reacts(states.signals)
