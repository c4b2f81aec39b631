"""What a proposal may know of an encounter's states, in the turn of each slot."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.encounters.names import ASIDE, EGO_SPEED, GAP, HEADING, SPEED, of_cars
from pemviz.simulators.encounters.scenario import LogicalScenario
from pemviz.simulators.slots import UnrolledSimulator
from pemviz.types import StateBatch

FARTHEST_M = 80.0
"""Gaps are told apart up to here."""


@dataclass(frozen=True)
class EncounterFeatures:
    """The slot's gap, offset and closing speed, time, its number; its track, if there is one.

    Attributes:
        unrolled: The encounter in single outcomes.
        scenario: The encounter.
    """

    unrolled: UnrolledSimulator
    scenario: LogicalScenario

    def values(self, states: StateBatch) -> FloatArray:
        """Numbers ``[..., D]``."""
        signals, slot = states.signals, self.unrolled.slot_of(states.signals)
        turn, cars = self.unrolled.turn_at(states), self._in_turn(states)
        along_mps = of_cars(SPEED, cars, signals) * np.cos(of_cars(HEADING, cars, signals))
        of_all = [
            of_cars(GAP, cars, signals).clip(-FARTHEST_M, FARTHEST_M),
            np.abs(of_cars(ASIDE, cars, signals)),
            signals[EGO_SPEED] - along_mps,
        ]
        tracker = self.scenario.tracker
        if tracker is not None:
            every = tracker.numbers(tracker.state(states.memory, slots=self.unrolled.turns))[:2]
            own = [np.moveaxis(one, -1, 0) for one in every]
            of_all += own if turn is None else [one[turn : turn + 1] for one in own]
        if turn is None:
            columns = [np.take_along_axis(one, slot[None], axis=0)[0] for one in of_all]
        else:
            columns = [one[0] for one in of_all]
        time_s = np.asarray(states.step // self.unrolled.turns) * self.scenario.dt_s
        columns.append(np.broadcast_to(time_s, slot.shape))
        if self.unrolled.turns > 1:
            columns.append(slot.astype(np.float64))
        return np.stack(columns, axis=-1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where the ego might do otherwise for the slot's outcome, ``[...]``."""
        return self.unrolled.reacts_at(states)

    def reacts_within(self, states: StateBatch, *, steps: int) -> BoolArray:
        """Where it might, or would a few steps on if all cars went on as they are, ``[...]``."""
        found = self.reacts(states)
        for share in (0.5, 1.0):
            later_s = share * steps * self.scenario.dt_s
            found = found | self.reacts(self._later(states, later_s))
        return found

    def _in_turn(self, states: StateBatch) -> Sequence[str]:
        """What the slots in turn are about: one, or all if the states differ in that."""
        turn, names = self.unrolled.turn_at(states), self.scenario.told_of
        return names if turn is None else names[turn : turn + 1]

    def _later(self, states: StateBatch, later_s: float) -> StateBatch:
        """States when all cars in turn have gone on with their speeds and headings."""
        signals = states.signals
        moved = dict(signals)
        for car in self._in_turn(states):
            speed_mps, heading_rad = signals[f"{SPEED}_{car}"], signals[f"{HEADING}_{car}"]
            closing_mps = signals[EGO_SPEED] - speed_mps * np.cos(heading_rad)
            moved[f"{GAP}_{car}"] = signals[f"{GAP}_{car}"] - closing_mps * later_s
            aside_mps = speed_mps * np.sin(heading_rad)
            moved[f"{ASIDE}_{car}"] = signals[f"{ASIDE}_{car}"] + aside_mps * later_s
        return StateBatch(states.step, moved, states.memory)
