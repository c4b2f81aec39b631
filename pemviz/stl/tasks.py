"""What loops over steps are given and hand to each other: see :mod:`pemviz.stl.loops`."""

from typing import Any, NamedTuple

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.lanes import LANES

WHOLE = 128
"""Steps that are folded within registers; fewer are made as many by zeros."""


class Task(NamedTuple):
    """What is folded.

    Attributes:
        values: ``[n, T]``, rows in one piece.
        start: First step.
        stop: The step after the last.
        offset: Of the signal.
        factor: Of its distance from there; negative where it is to be small.
        low: Least value that is allowed at any of the T steps.
        high: Largest.
    """

    values: FloatArray
    start: int
    stop: int
    offset: float
    factor: float
    low: float
    high: float


class Means(NamedTuple):
    """What agm's conjunction of all steps rests on; written to.

    Attributes:
        fails: ``[n]``, whether a step's distance is at most 0.
        failing: ``[n]``: where one does, the sum of min(distance, 0).
        growth: ``[groups, n]``: where none does, prod(1 + distance) - 1 of each group.
        part: Where it is worked out: zeros for all steps, a power of two of them, `WHOLE` at least.
    """

    fails: BoolArray
    failing: FloatArray
    growth: FloatArray
    part: FloatArray


def means_of(count: int, width: int, groups: int) -> Means:
    """Room for ``count`` rows."""
    size = max(1 << (width - 1).bit_length(), WHOLE)
    zeros = np.zeros(size + LANES)
    first = -(zeros.ctypes.data // zeros.itemsize) % LANES  # eight lie in one line of the cache
    part = zeros[first : first + size]
    return Means(np.empty(count, np.bool_), np.zeros(count), np.zeros((groups, count)), part)


class Near(NamedTuple):
    """Which steps count in a soft minimum; see `pemviz.stl.dominant.DominantSteps`.

    Attributes:
        beta: Sharpness.
        positive: Which part.
        reach: A step counts whose distance is at most this above the row's base.
        largest: Exponent; above it stands this one.
        base: ``[n]``, written to.
        ends: ``[n + 1]``: row i's exponents stand from ``ends[i]`` to ``ends[i + 1]``.
        exponents: Written to, all rows' one after another.
    """

    beta: float
    positive: bool
    reach: float
    largest: float
    base: FloatArray
    ends: IntArray
    exponents: FloatArray


class Rows(NamedTuple):
    """A task to those who are called for every row.

    Attributes:
        values: Its memory.
        states: T.
        start: First step.
        width: How many steps.
        offset: Of the signal.
        factor: Of its distance from there.
    """

    values: Any
    states: int
    start: int
    width: int
    offset: float
    factor: float


class Seen(NamedTuple):
    """What eight neighbours each have seen of values.

    Attributes:
        least: The least one.
        most: The largest.
        wrong: NaN if one was not finite, otherwise 0.
    """

    least: Any
    most: Any
    wrong: Any


class Packing(NamedTuple):
    """What is `Near` to those who are called for every row.

    Attributes:
        rate: -beta.
        reach: As there.
        largest: As there.
        exponents: Their memory.
    """

    rate: float
    reach: float
    largest: float
    exponents: Any
