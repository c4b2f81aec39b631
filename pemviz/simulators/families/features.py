"""What a proposal may know of an encounter's states, in the turn of each slot."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.families.names import ASIDE, EGO_SPEED, GAP, HEADING, SPEED, of_cars
from pemviz.simulators.families.scenario import FamilyScenario
from pemviz.simulators.slots import UnrolledSimulator
from pemviz.types import StateBatch

FARTHEST_M = 80.0
"""Gaps are told apart up to here."""


@dataclass(frozen=True)
class FamilyFeatures:
    """The slot's gap, offset and closing speed, time, its number; its track, if there is one.

    Attributes:
        unrolled: The encounter in single outcomes.
        scenario: The encounter.
    """

    unrolled: UnrolledSimulator
    scenario: FamilyScenario

    def values(self, states: StateBatch) -> FloatArray:
        """Numbers ``[..., D]``."""
        signals, cars = states.signals, self.scenario.told_of
        slot = self.unrolled.slot_of(signals)
        along_mps = of_cars(SPEED, cars, signals) * np.cos(of_cars(HEADING, cars, signals))
        of_all = [
            of_cars(GAP, cars, signals).clip(-FARTHEST_M, FARTHEST_M),
            np.abs(of_cars(ASIDE, cars, signals)),
            signals[EGO_SPEED] - along_mps,
        ]
        tracker = self.scenario.tracker
        if tracker is not None:
            numbers = tracker.numbers(tracker.state(states.memory, slots=len(cars)))
            of_all += [np.moveaxis(one, -1, 0) for one in numbers[:2]]
        columns = [np.take_along_axis(one, slot[None], axis=0)[0] for one in of_all]
        time_s = np.asarray(states.step // self.unrolled.turns) * self.scenario.dt_s
        columns.append(np.broadcast_to(time_s, slot.shape))
        if self.unrolled.turns > 1:
            columns.append(slot.astype(np.float64))
        return np.stack(columns, axis=-1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where the ego might do otherwise for the slot's outcome, ``[...]``."""
        return self.unrolled.reacts(states.signals)

    def reacts_within(self, states: StateBatch, *, steps: int) -> BoolArray:
        """Where it might, or would a few steps on if all cars went on as they are, ``[...]``."""
        found = self.reacts(states)
        for share in (0.5, 1.0):
            later_s = share * steps * self.scenario.dt_s
            found = found | self.unrolled.reacts(self._later(states.signals, later_s))
        return found

    def _later(self, signals: Mapping[str, FloatArray], later_s: float) -> dict[str, FloatArray]:
        """Signals when all cars have gone on with their speeds and headings."""
        moved = dict(signals)
        for car in self.scenario.told_of:
            speed_mps, heading_rad = signals[f"{SPEED}_{car}"], signals[f"{HEADING}_{car}"]
            closing_mps = signals[EGO_SPEED] - speed_mps * np.cos(heading_rad)
            moved[f"{GAP}_{car}"] = signals[f"{GAP}_{car}"] - closing_mps * later_s
            aside_mps = speed_mps * np.sin(heading_rad)
            moved[f"{ASIDE}_{car}"] = signals[f"{ASIDE}_{car}"] + aside_mps * later_s
        return moved
