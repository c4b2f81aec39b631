"""Evaluation of row functions in chunks of fixed size.

A matrix product may round a row differently in batches of different sizes. In chunks of
one size, the last padded, a row's result depends on nothing but the row. Rows that are equal
are therefore evaluated once: of a scenario's states at one step, most often are.
"""

from collections.abc import Callable

import numpy as np

from pemviz.arrays import FloatArray, IntArray

ROWS = 256
WORTH_FINDING = 0.75
"""Of a few rows, so many at most may be distinct for a search of all rows for equal ones."""
WORTH_USING = 0.5
"""Of all rows, so many at most may be distinct for each to be evaluated once."""


def map_rows(function: Callable[[FloatArray], FloatArray], rows: FloatArray) -> FloatArray:
    """Apply ``function`` (``[ROWS, D]`` to ``[ROWS]``) to rows ``[N, D]``, giving ``[N]``."""
    return map_distinct(lambda distinct: _map_chunks(function, distinct), rows)


def map_distinct(function: Callable[[FloatArray], FloatArray], rows: FloatArray) -> FloatArray:
    """Apply ``function`` (``[M, D]`` to ``[M]``, row by row) to rows ``[N, D]``, giving ``[N]``.

    Equal rows are evaluated once, where there are many and they are quickly found.
    """
    found = _distinct(rows)
    if found is None:
        return function(rows)
    distinct, index = found
    return function(distinct)[index]


def _distinct(rows: FloatArray) -> tuple[FloatArray, IntArray] | None:
    """Distinct rows ``[M, D]`` and which of them each row is ``[N]``.

    ``None`` where there is little to gain, or where more than one column varies.
    """
    count = rows.shape[0]
    if count <= ROWS:
        return None
    some = rows[:: count // ROWS]
    if np.count_nonzero((some != some[0]).any(axis=0)) > 1:
        return None
    varying = np.flatnonzero((rows != rows[0]).any(axis=0))
    if varying.size == 0:
        return rows[:1], np.zeros(count, dtype=np.int64)
    column = rows[:, varying[0]]
    if varying.size > 1 or np.unique(some[:, varying[0]]).size > WORTH_FINDING * some.shape[0]:
        return None
    ordered = np.sort(column)
    values = ordered[np.append(True, ordered[1:] != ordered[:-1])]
    if values.size > WORTH_USING * count:
        return None
    distinct = np.repeat(rows[:1], values.size, axis=0)
    distinct[:, varying] = values[:, None]
    return distinct, np.searchsorted(values, column)


def _map_chunks(function: Callable[[FloatArray], FloatArray], rows: FloatArray) -> FloatArray:
    count = rows.shape[0]
    result = np.empty(count)
    for start in range(0, count, ROWS):
        chunk = rows[start : start + ROWS]
        size = chunk.shape[0]
        if size < ROWS:
            chunk = np.concatenate([chunk, np.zeros((ROWS - size, rows.shape[1]))])
        result[start : start + size] = function(np.ascontiguousarray(chunk))[:size]
    return result
