"""Eight doubles at once, for loops that a compiler does not widen itself.

Here eight doubles are an array, and the functions are what they say. In loops that numba compiles
they are a wide register, by :mod:`pemviz.stl.wide_lanes`. Either way each of the eight goes through
the arithmetic of a double alone, so that results are the same to the last bit.
"""

from __future__ import annotations

import numpy as np

from pemviz.arrays import FloatArray

LANES = 8


def filled(value: float) -> FloatArray:
    """Eight times ``value``."""
    return np.full(LANES, value)


def loaded(values: FloatArray, first: int) -> FloatArray:
    """``values[first]`` and the seven after it."""
    return values[first : first + LANES].copy()


def store(eight: FloatArray, values: FloatArray, first: int) -> None:
    """Write eight to ``values[first]`` and the seven places after it."""
    values[first : first + LANES] = eight


def smaller(left: FloatArray, right: FloatArray) -> FloatArray:
    """The smaller one of each pair."""
    return np.where(right < left, right, left)


def pack(
    eight: FloatArray, keys: FloatArray, edge: FloatArray, values: FloatArray, first: int
) -> int:
    """Write those whose key is up to its edge to ``values``, side by side from ``first`` on.

    Needs eight places, and may write to all of them.

    Returns:
        The place after the last one that is kept.
    """
    kept = eight[keys <= edge]
    values[first : first + kept.size] = kept
    return first + kept.size
