"""Salient variables for tests."""

import numpy as np
from hypothesis import strategies as st

from pemviz.pem import SALIENT_COLUMNS


def braking_rows(gaps_m) -> np.ndarray:
    """Salient variables [n, 11] of the braking scenario at the given gaps."""
    gaps_m = np.asarray(gaps_m, dtype=float)
    z = gaps_m + 2.5
    rows = np.zeros((len(z), len(SALIENT_COLUMNS)))
    rows[:, 3] = -np.pi / 2 - np.arctan2(0.0, z)
    rows[:, 4:7] = (1.53, 1.63, 5.0)
    rows[:, 8] = 1.65
    rows[:, 9] = z
    rows[:, 10] = -np.pi / 2
    return rows


def random_rows(rng: np.random.Generator, count: int) -> np.ndarray:
    """Salient variables [count, 11] over all that the models accept."""
    rows = np.empty((count, len(SALIENT_COLUMNS)))
    rows[:, 0] = rng.integers(0, 7, count)
    rows[:, 1] = rng.random(count)
    rows[:, 2] = rng.integers(0, 3, count)
    rows[:, 3] = rng.uniform(-np.pi, np.pi, count)
    rows[:, 4:7] = rng.uniform(0.5, 6.0, (count, 3))
    rows[:, 7] = rng.normal(0, 10, count)
    rows[:, 8] = rng.normal(1.6, 0.4, count)
    rows[:, 9] = rng.uniform(-30, 90, count)
    rows[:, 10] = rng.uniform(-np.pi, np.pi, count)
    return rows


seeds = st.integers(0, 2**32 - 1)
