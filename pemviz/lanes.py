"""Eight doubles at once, for loops that a compiler does not widen itself.

Here eight doubles are an array, and the functions are what they say. In loops that numba compiles
they are a wide register, by :mod:`pemviz.wide_lanes`. Either way each of the eight goes through
the arithmetic of a double alone, so that results are the same to the last bit.
"""

from __future__ import annotations

import numpy as np

from pemviz.arrays import FloatArray

LANES = 8


def memory(values: FloatArray) -> FloatArray:
    """All of ``values``, in one piece, as what the words below read and write.

    In compiled loops it is an address: whom an array is handed to is counted, this is not. The
    array must be an argument of the loop, or it may be given back too soon.
    """
    return values.reshape(-1)


def filled(value: float) -> FloatArray:
    """Eight times ``value``."""
    return np.full(LANES, value)


def loaded(source: FloatArray, first: int) -> FloatArray:
    """``source[first]`` and the seven after it; of memory, or of an array in one piece."""
    return source[first : first + LANES].copy()


def store(eight: FloatArray, target: FloatArray, first: int) -> None:
    """Write eight to ``target[first]`` and the seven places after it."""
    target[first : first + LANES] = eight


def smaller(left: FloatArray, right: FloatArray) -> FloatArray:
    """The smaller one of each pair; the left one where they are not in order."""
    return np.where(right < left, right, left)


def larger(left: FloatArray, right: FloatArray) -> FloatArray:
    """The larger one of each pair; the left one where they are not in order."""
    return np.where(right > left, right, left)


def least_of(eight: FloatArray) -> float:
    """The smallest of eight, which are in order."""
    four = smaller(eight[:4], eight[4:])
    two = smaller(four[:2], four[2:])
    return float(smaller(two[:1], two[1:])[0])


def most_of(eight: FloatArray) -> float:
    """The largest of eight, which are in order."""
    four = larger(eight[:4], eight[4:])
    two = larger(four[:2], four[2:])
    return float(larger(two[:1], two[1:])[0])


def sum_of(eight: FloatArray) -> float:
    """The sum of eight, half upon half."""
    four = eight[:4] + eight[4:]
    return float((four[0] + four[2]) + (four[1] + four[3]))


def pack(
    eight: FloatArray, keys: FloatArray, edge: FloatArray, target: FloatArray, first: int
) -> int:
    """Write those whose key is up to its edge to ``target``, side by side from ``first`` on.

    Needs eight places, and may write to all of them.

    Returns:
        The place after the last one that is kept.
    """
    kept = eight[keys <= edge]
    target[first : first + kept.size] = kept
    return first + kept.size


def turn(  # noqa: PLR0917  (in compiled loops, where keywords are not known)
    source: FloatArray, first: int, apart: int, target: FloatArray, place: int, width: int
) -> None:
    """Write eight rows of eight as columns.

    Row i is read from ``source[first + i * apart]`` on, and column j goes to
    ``target[place + j * width]`` and the seven places after it.
    """
    rows = [loaded(source, first + i * apart) for i in range(LANES)]
    for j, column in enumerate(np.array(rows).T):
        store(column, target, place + j * width)
