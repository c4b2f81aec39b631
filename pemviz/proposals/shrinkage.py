"""Many values that are each known with an error, drawn towards what they have in common.

Of S values v_j with errors of variance e_j some may be the same, m, and the others lie around it::

    v_j = m + a_j + error_j,   a_j = 0 with probability 1 - pi, else N(0, t)

m, pi and t are those that make the values likeliest, by expectation and maximisation, and each
value becomes its expectation (empirical Bayes estimates of sparse sequences: Johnstone, Silverman
2004). Where all differ by much more than their errors that is next to nothing; where a hundred are
the same and a few not, the errors of the hundred are gone.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit

from pemviz.arrays import FloatArray

FEWEST = 10
"""Values that tell how many of them have something in common."""
ROUNDS = 20
LEAST_VARIANCE = 1e-12


@dataclass(frozen=True, eq=False)
class Shrinkage:
    """How values are drawn towards what they have in common: linear, once it is found.

    Attributes:
        weight: Of each in what is common, ``[S]``, sums to 1.
        own: How much of its distance from there each keeps, ``[S]``.
    """

    weight: FloatArray
    own: FloatArray

    def of(self, values: FloatArray) -> FloatArray:
        """Of values ``[..., S]``."""
        common = (values @ self.weight)[..., None]
        return common + self.own * (values - common)


def shrinkage(values: FloatArray, variance: FloatArray) -> Shrinkage:
    """That of values ``[S]`` with errors of ``variance [S]``, above 0."""
    if values.size < FEWEST:
        return Shrinkage(np.full(values.size, 1.0 / max(values.size, 1)), np.ones(values.size))
    common, part = float(np.median(values)), 0.5
    beyond = float(np.mean((values - common) ** 2 - variance))
    spread = 2.0 * max(beyond, LEAST_VARIANCE)
    apart, kept = np.empty(0), np.empty(0)
    for _ in range(ROUNDS):
        off, wide = (values - common) ** 2, spread + variance
        log_odds = 0.5 * (off / variance - off / wide + np.log(variance / wide))
        apart, kept = expit(log_odds + logit(part)), spread / wide
        weight = apart / wide + (1.0 - apart) / variance
        common = float(weight @ values / weight.sum())
        spread = float(apart @ (kept**2 * off + kept * variance) / apart.sum())
        spread = max(spread, LEAST_VARIANCE)
        part = (float(apart.sum()) + 0.5) / (values.size + 1.0)
    weight = (1.0 - apart * kept) / variance
    return Shrinkage(weight / weight.sum(), apart * kept)
