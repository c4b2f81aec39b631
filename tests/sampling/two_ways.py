"""The exact probability of a walk that fails in two ways, of which robustness shows one."""

import numpy as np
from scipy.special import expit

from benchmarks.trust_systems import TwoWayWalk
from tests.lattice_walk import ToyPem


def probabilities(toy: TwoWayWalk, pem: ToyPem) -> tuple[float, float]:
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
