"""Sliding windows over time by doubling.

An associative ``combine`` is applied to all windows of ``width`` consecutive steps
in about log2(width) passes over the data, instead of ``width`` passes.
"""

from __future__ import annotations

from collections.abc import Callable
from types import EllipsisType
from typing import Protocol, Self, TypeVar


class Sliceable(Protocol):
    """An array whose last axis is time."""

    def __getitem__(self, key: tuple[EllipsisType, slice], /) -> Self: ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes."""
        ...


ArrayT = TypeVar("ArrayT", bound=Sliceable)
Parts = tuple[ArrayT, ...]
Combine = Callable[[tuple[ArrayT, ...], tuple[ArrayT, ...]], tuple[ArrayT, ...]]


def _from(parts: Parts[ArrayT], start: int, steps: int) -> Parts[ArrayT]:
    return tuple(part[..., start : start + steps] for part in parts)


def sliding(combine: Combine[ArrayT], parts: Parts[ArrayT], width: int) -> Parts[ArrayT]:
    """``combine`` over every window, each sample counted exactly once.

    Args:
        combine: associative; its left argument is the earlier stretch of time.
        parts: arrays [..., T] that together describe each step.
        width: steps in a window, 1 <= width <= T.

    Returns:
        Arrays [..., T - width + 1].
    """
    steps = parts[0].shape[-1] - width + 1
    result: Parts[ArrayT] | None = None
    stretch, covered = 1, 0
    while True:
        if width & stretch:
            piece = _from(parts, covered, steps)
            result = piece if result is None else combine(result, piece)
            covered += stretch
        if covered == width:
            assert result is not None  # noqa: S101 (width >= 1)
            return result
        length = parts[0].shape[-1] - stretch
        parts = combine(_from(parts, 0, length), _from(parts, stretch, length))
        stretch *= 2


def sliding_idempotent(combine: Combine[ArrayT], parts: Parts[ArrayT], width: int) -> Parts[ArrayT]:
    """As `sliding`, where counting a sample twice changes nothing (minimum): fewer passes."""
    steps = parts[0].shape[-1] - width + 1
    stretch = 1
    while 2 * stretch <= width:
        length = parts[0].shape[-1] - stretch
        parts = combine(_from(parts, 0, length), _from(parts, stretch, length))
        stretch *= 2
    if stretch == width:
        return _from(parts, 0, steps)
    return combine(_from(parts, 0, steps), _from(parts, width - stretch, steps))
