"""What a proposal looks at in the turn of one of several cars that a tracker follows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.slots import Slot, UnrolledSimulator
from pemviz.simulators.tracking.tracker import Tracker
from pemviz.types import StateBatch

OF_TRACK = 2
"""Its hits, and the steps since the last one."""
FARTHEST_M = 100.0
"""Gaps are distinguished up to here."""
SlotSignals = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


class TracksCars(Protocol):
    """A scenario whose slots are cars."""

    @property
    def dt_s(self) -> float:
        """Time between two states [s]."""
        ...

    @property
    def slots(self) -> tuple[Slot, ...]:
        """The K cars."""
        ...

    @property
    def tracker(self) -> Any:
        """Between perception and controller, a tracker; ``None``: none."""
        ...

    def of_slots(self, signals: Mapping[str, FloatArray]) -> SlotSignals:
        """Gaps, offsets to the left [m], speeds [m/s] and headings [rad], ``[..., K]``."""
        ...


@dataclass(frozen=True)
class TrackedCarFeatures:
    """Of the car whose turn it is gap, offset, closing speed and track; the ego's speed; the time.

    Attributes:
        unrolled: The simulator, unrolled.
        simulator: The simulator.
    """

    unrolled: UnrolledSimulator
    simulator: TracksCars

    def values(self, states: StateBatch) -> FloatArray:
        """Gap [m], offset [m], closing speed and ego speed [m/s], time [s], ``[..., 5]``.

        With a tracker two more: hits of the track, and steps since the last.
        """
        slot = self.unrolled.slot_of(states.signals)[..., None]
        count = len(self.simulator.slots)
        gap_m, aside_m, speed_mps, _ = (
            np.take_along_axis(of_all, slot, axis=-1)[..., 0]
            for of_all in self.simulator.of_slots(states.signals)
        )
        gap_m = gap_m.clip(-FARTHEST_M, FARTHEST_M)
        ego_mps = states.signals["ego_speed"]
        time_s = np.asarray(states.step // count, dtype=np.float64) * self.simulator.dt_s
        columns: list[FloatArray] = [gap_m, aside_m, ego_mps - speed_mps, ego_mps]
        columns.append(np.zeros_like(gap_m) + time_s)
        tracker: Tracker | None = self.simulator.tracker
        if tracker is not None and (tracker.window > 1 or tracker.coast_steps > 0):
            tracks = tracker.state(states.memory, slots=count)
            columns += [
                np.take_along_axis(one, slot, axis=-1)[..., 0]
                for one in tracker.numbers(tracks)[:OF_TRACK]
            ]
        return np.stack(columns, axis=-1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where a detection of the car may matter, ``[...]``."""
        return self.unrolled.reacts_at(states)
