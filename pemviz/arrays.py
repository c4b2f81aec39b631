"""Array type names used in signatures, whose docstrings give the shapes; and batches of rows."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, fields
from typing import Any, ClassVar, Self, cast

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
AnyArray = NDArray[Any]
Rows = slice | BoolArray | IntArray
"""Which of N rows: a slice, a mask ``[N]``, or indices ``[M]`` in any order."""

LARGEST_NUMBER = 1e100
"""No signal and no logit of a rollout is larger: sums over a rollout stay finite."""

Merge = Callable[[Sequence[AnyArray]], AnyArray]


class Batch:
    """Base of frozen dataclasses that hold arrays with a row for each of N things.

    Their fields are arrays ``[N, ...]``, mappings of such arrays, or batches themselves, which may
    be absent (``None``): a field that is added takes part in all operations. Arrays in which the
    N things are neighbours in memory, not each thing's own values, come out of them likewise.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def map(self, function: Callable[[AnyArray], AnyArray]) -> Self:
        """The batch with ``function`` applied to every array."""
        return self._merged([self], lambda arrays: function(arrays[0]))

    def take(self, rows: Rows) -> Self:
        """The chosen rows, in the order of choice: views for a slice, otherwise copies."""
        return self.map(lambda values: _taken(values, rows))

    @classmethod
    def concatenate(cls, batches: Sequence[Self]) -> Self:
        """All rows of at least one batch, in order."""
        return batches[0] if len(batches) == 1 else cls._merged(batches, _concatenated)

    @classmethod
    def _merged(cls, batches: Sequence[Self], merge: Merge) -> Self:
        """``merge`` of the arrays that stand in the same place of all batches, for each place."""
        beside = cls._beside_rows(batches)
        places = {
            f.name: [getattr(batch, f.name) for batch in batches]
            for f in fields(cls)
            if f.name not in beside
        }
        return cls(**beside, **{name: cls._merged_place(p, merge) for name, p in places.items()})

    @staticmethod
    def _merged_place(place: Sequence[Any], merge: Merge) -> Any:
        first = place[0]
        if first is None:
            return None
        if isinstance(first, Batch):
            return first._merged(place, merge)
        if isinstance(first, Mapping):
            names = cast(Mapping[str, AnyArray], first)
            return {name: merge([arrays[name] for arrays in place]) for name in names}
        return merge(place)

    @classmethod
    def _beside_rows(cls, batches: Sequence[Any]) -> Mapping[str, Any]:  # noqa: ARG003
        """Values of the fields without rows, for a batch that is made of ``batches``."""
        return {}


def _taken(values: AnyArray, rows: Rows) -> AnyArray:
    if isinstance(rows, slice) or values.flags.c_contiguous:
        return values[rows]
    index = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
    return values.T.take(index, axis=-1).T


def _concatenated(arrays: Sequence[AnyArray]) -> AnyArray:
    if all(array.flags.c_contiguous for array in arrays):
        return np.concatenate(arrays)
    return np.concatenate([array.T for array in arrays], axis=-1).T


def read_only(array: AnyArray) -> AnyArray:
    """A view of ``array`` (any shape) that refuses writes."""
    view = array.view()
    view.flags.writeable = False
    return view


def row_sums(values: FloatArray) -> FloatArray:
    """Sums ``[N]`` over all axes but the first of ``[N, M]`` or ``[N, M, K]``.

    The order of additions depends on how an array lies in memory. Here it is always that of a
    row in one piece, whatever the layout, so that a row's sum does not depend on how many rows
    there are.
    """
    values = np.ascontiguousarray(values)
    # without rows numpy cannot tell how long one is
    length = math.prod(values.shape[1:])
    return np.sum(values if values.ndim == 2 else values.reshape(len(values), length), axis=1)


def softplus(values: FloatArray) -> FloatArray:
    """log(1 + exp(v)) for values of any shape ``[...]``, never overflowing.

    As ``np.logaddexp(0, v)`` within a last digit, from functions that numpy has vectorised.
    """
    rest = np.array(values, dtype=np.float64)
    np.abs(rest, out=rest)
    np.negative(rest, out=rest)
    np.exp(rest, out=rest)
    np.log1p(rest, out=rest)
    rest += np.maximum(values, 0.0)
    return rest


def log_sum_exp(values: FloatArray, *, axis: int | None = None) -> Any:
    """Log of the sum of exponentials over an axis, or over all of ``values [...]``.

    To the last bit what scipy's ``logsumexp`` gives for arrays of real numbers, in a fraction of
    its time for small ones. The largest are left out of the sum and counted, for precision.

    Args:
        values: Numbers, infinite ones too; of none the sum is 0.
        axis: That is summed over; all if ``None``.
    """
    if values.size == 0:
        kept = () if axis is None else np.delete(values.shape, axis)
        return np.full(tuple(kept), -np.inf)[()]
    with np.errstate(all="ignore"):  # infinities are seen to
        largest = values.max(axis=axis, keepdims=True)
        is_largest = values == largest
        count = is_largest.sum(axis=axis, keepdims=True, dtype=np.float64)
        others = np.where(is_largest, -np.inf, values)
        others -= largest
        rest = np.exp(others, out=others).sum(axis=axis, keepdims=True)
        found = np.log1p(np.where(rest == 0.0, rest, rest / count)) + np.log(count) + largest
        undefined = ~np.isfinite(found)
        if undefined.any():
            plain = np.log(np.exp(values).sum(axis=axis, keepdims=True))
            found = np.where(undefined, plain, found)
    return found.squeeze(axis=axis)


def times_sampled(weight: FloatArray, count: int) -> IntArray:
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
    return times_sampled(weight, most) * (weight.sum() / most)
