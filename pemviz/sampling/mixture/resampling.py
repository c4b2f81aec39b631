"""A bounded number of weighted rollouts in place of very many, drawn systematically.

Of N rollouts with weights w_i that sum to W, those are taken on which the places (j + 1/2) W / M,
j = 0 .. M - 1, fall when the weights are laid end to end (systematic resampling: Kitagawa 1996).
Each that is taken counts W / M for every place on it: a weighted sum over the rollouts changes by
its spread over sqrt(M) at most, and by less where neighbours are alike.
"""

import numpy as np

from pemviz.arrays import FloatArray, IntArray


def times_drawn(weight: FloatArray, count: int) -> IntArray:
    """How often each of weighted rollouts ``[N]`` is among ``count`` drawn in even steps."""
    edges = np.cumsum(weight)
    places = (np.arange(count) + 0.5) / count * edges[-1]
    return np.bincount(np.searchsorted(edges, places), minlength=weight.size).astype(np.int64)


def at_most(weight: FloatArray, most: int) -> FloatArray:
    """The same weights ``[N]`` if ``most`` are not 0, else those of as many drawn, 0 elsewhere.

    Either sum to the same.
    """
    if np.count_nonzero(weight) <= most:
        return weight
    return times_drawn(weight, most) * (weight.sum() / most)
