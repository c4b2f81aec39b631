"""Seeds: every stage's and every network's, from the run's own by numpy's SeedSequence."""

import numpy as np


def stage_seeds(*, seed: int, repetition: int, stage: int) -> np.random.SeedSequence:
    """The seed sequence of one stage; depends on nothing but these three numbers."""
    return np.random.SeedSequence(seed, spawn_key=(repetition, stage))


def network_seed(*, seed: int, repetition: int) -> int:
    """A 63-bit seed for the proposal network's initial weights."""
    sequence = np.random.SeedSequence(seed, spawn_key=(repetition, 2**32 - 1))
    return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))
