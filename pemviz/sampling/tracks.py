"""What proposals see of the tracks that a simulator of the user's own holds."""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.simulators.slots import UnrolledSimulator
from pemviz.simulators.tracking.tracker import Tracker
from pemviz.types import StateBatch


@dataclass(frozen=True)
class TrackFeatures:
    """What the scenario's states offer to look at, and the tracks; of a slot in its turn, its own.

    Attributes:
        features: The scenario's own.
        tracker: The tracker, whose state lies in the states' memory.
        unrolled: The scenario, if it has slots.
    """

    features: StateFeatures
    tracker: Tracker
    unrolled: UnrolledSimulator | None = None

    def values(self, states: StateBatch) -> FloatArray:
        """The scenario's features and :meth:`Tracker.numbers`, ``[..., D]``."""
        own = self.features.values(states)
        if self.unrolled is None:
            numbers = self.tracker.numbers(self.tracker.state(states.memory))
        else:
            slot = self.unrolled.slot_of(states.signals)[..., None]
            tracks = self.tracker.state(states.memory, slots=self.unrolled.turns)
            of_all = self.tracker.numbers(tracks)
            numbers = [np.take_along_axis(one, slot, axis=-1)[..., 0] for one in of_all]
        return np.concatenate((own, np.stack(numbers, -1)), -1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where the scenario may react to what is tracked, ``[...]``."""
        return self.features.reacts(states)
