"""A walk that fails in two ways, of which robustness shows one; its probability is exact.

The walk fails where its gap arrives at 0, as the toy's does. It also fails, at its last state and
without a sign before, if perception missed at all of some steps: a chain to which nothing that
robustness or a signal shows leads.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.types import Signal, StateBatch
from tests.lattice_walk import GAP, ToyPem

UNSEEN = "unseen"


@dataclass(frozen=True, kw_only=True)
class TwoWays:
    """The walk.

    Attributes:
        watched: If all of these steps were missed, the gap is 0 at the last state.
        still: Before this step the gap does not move.
        initial_gap: Where the walk starts.
        largest_gap: Detections do not lead beyond it.
        states: States in a rollout.
    """

    watched: tuple[int, ...]
    still: int = 0
    initial_gap: int = 6
    largest_gap: int = 8
    states: int = 19

    name = "two-ways"
    dt_s = 1.0

    @property
    def signals(self):
        return (Signal(name=GAP, key="gap_m", unit="m", low=0.0, high=float(self.largest_gap)),)

    def initial(self, *, count: int) -> StateBatch:
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={GAP: np.full(count, float(self.initial_gap))},
            memory={UNSEEN: np.ones(count, dtype=np.bool_)},
        )

    def step(self, states: StateBatch, detected) -> StateBatch:
        step = int(states.step)
        gap, unseen = states.signals[GAP], states.memory[UNSEEN]
        if step >= self.still:
            gap = np.minimum(gap + np.where(detected, 1.0, -1.0), float(self.largest_gap))
        if step in self.watched:
            unseen = unseen & ~detected
        if step == self.states - 2:
            gap = np.where(unseen, 0.0, gap)
        return StateBatch(step=states.step + 1, signals={GAP: gap}, memory={UNSEEN: unseen})

    def salient(self, signals: Mapping[str, np.ndarray]) -> np.ndarray:
        return signals[GAP][..., None]


def probabilities(toy: TwoWays, pem: ToyPem) -> tuple[float, float]:
    """Of arriving at 0 before the last state or there by a miss, and of failing at all.

    Forward over the gaps, for rollouts that were missed at all watched steps and for others.
    """
    gaps = np.arange(toy.largest_gap + 1)
    missed = expit(-pem.logit(gaps[:, None].astype(np.float64)))
    mass = {True: (gaps == toy.initial_gap).astype(np.float64), False: np.zeros(gaps.size)}
    arrived = 0.0
    for step in range(toy.states - 1):
        following = {True: np.zeros(gaps.size), False: np.zeros(gaps.size)}
        for unseen, here in mass.items():
            for hit, chance in ((False, missed), (True, 1.0 - missed)):
                still = unseen and not (hit and step in toy.watched)
                moved = np.clip(gaps + (1 if hit else -1), 0, toy.largest_gap)
                after = moved if step >= toy.still else gaps
                np.add.at(following[still], after, here * chance)
        for here in following.values():
            arrived += float(here[0])
            here[0] = 0.0
        mass = following
    return arrived, arrived + float(mass[True].sum())
