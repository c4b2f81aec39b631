"""Levels of robustness and the elites below them."""

import math

import numpy as np

from pemviz.arrays import BoolArray, FloatArray

VIOLATION_THRESHOLD = 0.0


def elite_threshold(robustness: FloatArray, *, sigma: float) -> float:
    """The stage's level: element floor(sigma N) of robustness ``[N]`` sorted descending.

    Never below 0, the threshold of violation (the paper's Algorithm 1, lines 6 and 7).
    """
    descending = np.sort(robustness)[::-1]
    # a product such as 0.95 * 100 must not round below the whole number it stands for
    index = min(math.floor(sigma * robustness.size + 1e-9), robustness.size - 1)
    return max(float(descending[index]), VIOLATION_THRESHOLD)


def elites(robustness: FloatArray, *, threshold: float) -> BoolArray:
    """Which of ``[N]`` rollouts lie at or below the level, ties included."""
    return robustness <= threshold
