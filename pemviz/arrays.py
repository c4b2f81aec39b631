"""Array type names used in signatures; shapes stand in the docstrings."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
AnyArray = NDArray[Any]


def read_only(array: AnyArray) -> AnyArray:
    """A view of ``array`` (any shape) that refuses writes."""
    view = array.view()
    view.flags.writeable = False
    return view


def row_sums(values: FloatArray) -> FloatArray:
    """Sums ``[N]`` over the second axis of ``[N, M]``.

    The order of additions depends on the memory layout; in C order a row's sum does not
    depend on how many rows there are.
    """
    return np.sum(np.ascontiguousarray(values), axis=1)
