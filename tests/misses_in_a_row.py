"""A system of which the probability of a violation is known: so many misses in a row decide."""

from dataclasses import dataclass

import numpy as np

from pemviz.sampling.problem import Problem
from pemviz.types import Signal, StateBatch
from tests.toy import ConstantPem

STEPS = 100


@dataclass(frozen=True)
class MissesInARow:
    """It fails where so many misses follow each other, at any time; else every step is alike.

    Attributes:
        needed: How many.
        shown: Whether the gap shows how many are missing still; else it is 1 until they are there.
        later: Steps from the last of them to the failure, whatever is detected until then.
        phases: Signals beside, that tell nothing.
    """

    needed: int = 1
    shown: bool = False
    later: int = 0
    phases: int = 0
    states: int = STEPS + 1
    name: str = "misses-in-a-row"
    dt_s: float = 1.0

    @property
    def signals(self):
        gap = Signal("gap", "gap", "", 0.0, float(self.needed + self.later))
        beside = (Signal(f"phase{k}", f"phase{k}", "", -1.0, 1.0) for k in range(self.phases))
        return (gap, *beside)

    def initial(self, *, count):
        return self._states(np.zeros((), dtype=np.int64), np.zeros(count))

    def step(self, states, detected):
        row = states.memory["row"]
        missed = np.where(detected, 0.0, row + 1.0)
        doomed = np.minimum(row + 1.0, self.needed + self.later)
        return self._states(states.step + 1, np.where(row >= self.needed, doomed, missed))

    def _states(self, step, row):
        left = self.needed + self.later - row
        gap = left if self.shown else (left > 0.0) * 1.0
        waves = {
            f"phase{k}": np.full(row.shape, np.sin(step * (0.3 + 0.2 * k)))
            for k in range(self.phases)
        }
        return StateBatch(step=step, signals={"gap": gap, **waves}, memory={"row": row})

    def salient(self, signals):
        return signals["gap"][..., None]


def probability(system, miss):
    """That so many misses follow each other early enough, by how many do so far."""
    row = np.zeros(system.needed)
    row[0] = 1.0
    for _ in range(system.states - 1 - system.later):
        row = np.concatenate([[row.sum() * (1.0 - miss)], row[:-1] * miss])
    return 1.0 - float(row.sum())


def problem_of(system, miss):
    return Problem(
        simulator=system,
        pem=ConstantPem(miss),
        robustness=lambda signals: signals["gap"].min(axis=1) - 0.5,
        violated=None,
        unsafe=lambda states: states.signals["gap"] < 0.5,
    )
