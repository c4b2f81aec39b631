"""Evaluation of row functions in chunks, each distinct row once.

A matrix product may round a row differently in batches of different sizes. In chunks of
one size, the last padded, a row's result depends on nothing but the row; so rows that are
equal, as those of rollouts that have met the same misses, need only be evaluated once.
"""

from collections.abc import Callable

import numpy as np

from pemviz.arrays import FloatArray, IntArray

ROWS = 256
FEWEST = 4 * ROWS
"""Fewer rows are not searched for those that are equal."""
MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # odd; 2^64 over the golden ratio


def map_rows(
    function: Callable[[FloatArray], FloatArray], rows: FloatArray, *, padded: bool = True
) -> FloatArray:
    """Apply ``function`` (``[ROWS, D]`` to ``[ROWS]``) to rows ``[N, D]``, giving ``[N]``.

    ``padded`` where what the function gives a row depends on how many there are, so that the last
    chunk has to be filled up with zeros.
    """

    def in_chunks(distinct: FloatArray) -> FloatArray:
        result = np.empty(len(distinct))
        for start in range(0, len(distinct), ROWS):
            chunk = distinct[start : start + ROWS]
            size = len(chunk)
            if padded and size < ROWS:
                chunk = np.concatenate([chunk, np.zeros((ROWS - size, rows.shape[1]))])
            result[start : start + size] = function(chunk)[:size]
        return result

    return map_distinct(in_chunks, rows)


def map_distinct(function: Callable[[FloatArray], FloatArray], rows: FloatArray) -> FloatArray:
    """Apply ``function`` (``[M, D]`` to ``[M]``, row by row) to rows ``[N, D]``, giving ``[N]``."""
    merged = distinct_rows(rows) if rows.shape[0] >= FEWEST else None
    if merged is None:
        return function(rows)
    first, place = merged
    return function(rows[first])[place]


def distinct_rows(rows: FloatArray) -> tuple[IntArray, IntArray] | None:
    """Where each distinct row of ``[N, D]`` comes first ``[M]``, and which each row is ``[N]``.

    ``None`` where more than half are distinct, so that it does not pay to know.
    """
    bits = np.asarray(rows, dtype=np.float64).view(np.uint64)
    columns = [column for column in bits.T if not (column == column[:1]).all()]
    hashes = np.zeros(rows.shape[0], dtype=np.uint64)  # one number for each row
    for column in columns:
        hashes ^= column
        hashes *= MULTIPLIER
        hashes ^= hashes >> np.uint64(29)
    first, place = distinct(hashes.view(np.int64))
    if 2 * first.size > rows.shape[0]:
        return None
    like = first[place]
    if not all(np.array_equal(column[like], column) for column in columns):
        return None  # two rows share a hash
    return first, place


def distinct(keys: IntArray) -> tuple[IntArray, IntArray]:
    """Where each distinct key of ``[N]`` comes first ``[M]``, in order, and which each is ``[N]``.

    A hash table that is written and read by whole arrays: linear in N, where sorting is not.
    Keys whose place another key takes are placed anew by another hash.
    """
    shift = np.uint64(63 - max(keys.size, 1).bit_length())
    every = np.arange(keys.size, dtype=np.int32)  # half the memory traffic of int64
    table = np.empty(1 << (64 - int(shift)), dtype=np.int32)
    first = np.empty_like(every)
    left, of_left, multiplier = every, keys.view(np.uint64), MULTIPLIER
    while left.size:
        place = ((of_left * multiplier) >> shift).view(np.int64)
        table[place[::-1]] = left[::-1]  # the last one written stays: the first of its place
        taker = table[place]
        same = keys[taker].view(np.uint64) == of_left
        first[left[same]] = taker[same]
        others = np.flatnonzero(~same)
        left, of_left = left[others], of_left[others]
        multiplier += np.uint64(2)  # stays odd
    is_first = first == every
    return np.flatnonzero(is_first), (np.cumsum(is_first) - 1)[first]
