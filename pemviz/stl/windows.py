"""Combining values over stretches of time, by doubling.

Arrays have time first, [steps, ...]. An associative ``combine`` is applied to all
windows of ``width`` consecutive steps in about log2(width) passes over the data,
instead of ``width`` passes.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Protocol, Self, TypeVar

from pemviz.arrays import FloatArray


class Sliceable(Protocol):
    """An array whose first axis is time."""

    def __getitem__(self, key: slice, /) -> Self: ...

    def __len__(self) -> int: ...


ArrayT = TypeVar("ArrayT", bound=Sliceable)
Parts = tuple[ArrayT, ...]
Combine = Callable[[tuple[ArrayT, ...], tuple[ArrayT, ...]], tuple[ArrayT, ...]]


def _from(parts: Parts[ArrayT], start: int, steps: int) -> Parts[ArrayT]:
    return tuple(part[start : start + steps] for part in parts)


def sliding(combine: Combine[ArrayT], parts: Parts[ArrayT], width: int) -> Parts[ArrayT]:
    """``combine`` over every window, each step counted exactly once.

    Args:
        combine: associative; its left argument is the earlier stretch of time.
        parts: arrays [T, ...] that together describe each step.
        width: steps in a window, 1 <= width <= T.

    Returns:
        Arrays [T - width + 1, ...].
    """
    steps = len(parts[0]) - width + 1
    result: Parts[ArrayT] | None = None
    stretch, covered = 1, 0
    while True:
        if width & stretch:
            piece = _from(parts, covered, steps)
            result = piece if result is None else combine(result, piece)
            covered += stretch
        if result is not None and covered == width:
            return result
        parts = _doubled(combine, parts, stretch)
        stretch *= 2


def sliding_idempotent(combine: Combine[ArrayT], parts: Parts[ArrayT], width: int) -> Parts[ArrayT]:
    """As `sliding`, where counting a step twice changes nothing (minimum): fewer passes."""
    steps = len(parts[0]) - width + 1
    stretch = 1
    while 2 * stretch <= width:
        parts = _doubled(combine, parts, stretch)
        stretch *= 2
    if stretch == width:
        return _from(parts, 0, steps)
    return combine(_from(parts, 0, steps), _from(parts, width - stretch, steps))


def _doubled(combine: Combine[ArrayT], parts: Parts[ArrayT], stretch: int) -> Parts[ArrayT]:
    length = len(parts[0]) - stretch
    return combine(_from(parts, 0, length), _from(parts, stretch, length))


def fold(ufunc: Callable[..., Any], values: FloatArray) -> FloatArray:
    """``ufunc`` over the whole time axis, half upon half of the next power of two, in place.

    Unlike numpy's own reductions it adds in an order that does not depend on the number
    of rollouts, and its rounding error grows with log T only.

    Args:
        ufunc: elementwise, associative and commutative; takes ``out``.
        values: [T, n], T >= 1; overwritten.

    Returns:
        [1, n], a view of ``values``.
    """
    while len(values) > 1:
        half = half_of(len(values))
        folded = values[: len(values) - half]
        ufunc(folded, values[half:], out=folded)
        values = values[:half]
    return values


def half_of(steps: int) -> int:
    """Half of the least power of two that is ``steps`` or more, of two steps or more."""
    return 1 << ((steps - 1).bit_length() - 1)


def running(ufunc: Callable[..., Any], values: FloatArray) -> FloatArray:
    """``ufunc`` over the steps up to each, [T, n], in place; numpy's own takes rollouts in turn."""
    for before, now in pairwise(values):
        ufunc(before, now, out=now)
    return values
