"""Evaluation of row functions in chunks of fixed size.

A matrix product may round a row differently in batches of different sizes. In chunks of
one size, the last padded, a row's result depends on nothing but the row.
"""

from collections.abc import Callable

import numpy as np

from pemviz.arrays import FloatArray

ROWS = 256


def map_rows(function: Callable[[FloatArray], FloatArray], rows: FloatArray) -> FloatArray:
    """Apply ``function`` (``[ROWS, D]`` to ``[ROWS]``) to rows ``[N, D]``, giving ``[N]``."""
    count = rows.shape[0]
    result = np.empty(count)
    for start in range(0, count, ROWS):
        chunk = rows[start : start + ROWS]
        size = chunk.shape[0]
        if size < ROWS:
            chunk = np.concatenate([chunk, np.zeros((ROWS - size, rows.shape[1]))])
        result[start : start + size] = function(np.ascontiguousarray(chunk))[:size]
    return result
