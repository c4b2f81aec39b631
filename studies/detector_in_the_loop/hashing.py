"""Random numbers that belong to a rollout, a step and a purpose, and to nothing else.

What changes from frame to frame must not depend on which frames are rendered, in which order, or
how many at a time. So it is a hash of the rollout's own seed, the step and a number for the
purpose: the finaliser of SplitMix64 (Steele, Lea, Flood 2014), which passes BigCrush as a counter.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pemviz.arrays import FloatArray

Seeds = NDArray[np.uint64]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_PURPOSE = np.uint64(0xD1342543DE82EF95)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


def hashed(seeds: Seeds, step: Any, purpose: int) -> Seeds:
    """64 random bits for seeds ``[N]``, steps that broadcast against them, and a purpose."""
    with np.errstate(over="ignore"):
        mixed = seeds + np.asarray(step).astype(np.uint64) * _GOLDEN
        mixed = mixed ^ (np.uint64(purpose + 1) * _PURPOSE)
        for _ in range(2):  # once is not enough where the seeds themselves are counted up
            mixed = mixed + _GOLDEN
            mixed = (mixed ^ (mixed >> np.uint64(30))) * _FIRST
            mixed = (mixed ^ (mixed >> np.uint64(27))) * _SECOND
            mixed = mixed ^ (mixed >> np.uint64(31))
    return mixed


def uniforms(seeds: Seeds, step: Any, purpose: int) -> FloatArray:
    """Uniforms in (0, 1) ``[N]``."""
    bits = (hashed(seeds, step, purpose) >> np.uint64(11)).astype(np.float64)
    return (bits + 0.5) * 2.0**-53


def normals(seeds: Seeds, step: Any, purpose: int) -> FloatArray:
    """Standard normals ``[N]``."""
    return np.asarray(ndtri(uniforms(seeds, step, purpose)), dtype=np.float64)
