"""Arithmetic-geometric mean robustness: Mehdipour, Vasile & Belta, ACC 2019.

Dimensionless: a predicate's margin is divided by the width of its range, computed from
declared bounds of the signals. The metric is discontinuous where a margin is exactly 0.
"""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pemviz.arrays import FloatArray
from pemviz.errors import InputError
from pemviz.stl.bounds import Interval, check_interval, margin_range
from pemviz.stl.formulas import Predicate
from pemviz.stl.numpy_base import NumpySemantics, window_chunks
from pemviz.stl.windows import sliding

SCENARIO_BOUNDS: Mapping[str, Interval] = {
    "gap": (-25.0, 25.0),
    "ego_speed": (0.0, 40.0),
    "lead_speed": (0.0, 40.0),
}
"""Bounds of the braking scenario: gap in m, speeds in m/s."""


@dataclass(frozen=True)
class Agm:
    """The arithmetic-geometric mean metric.

    Attributes:
        bounds: (low, high) of every signal that a formula uses, in the signal's unit.
        clip: whether values beyond their bounds count as the bound; otherwise they
            are an error.
    """

    bounds: Mapping[str, Interval] = field(default_factory=lambda: dict(SCENARIO_BOUNDS))
    clip: bool = False

    def __post_init__(self) -> None:
        checked = {name: check_interval(name, pair) for name, pair in self.bounds.items()}
        object.__setattr__(self, "bounds", checked)

    def __hash__(self) -> int:
        return hash((frozenset(self.bounds.items()), self.clip))


class Means(NamedTuple):
    """What a conjunction over several values depends on, each [n, steps].

    Sums of one sign only, so that no digits cancel.
    """

    least: FloatArray
    failing: FloatArray  # sum of min(value, 0)
    growth: FloatArray  # sum of log(1 + max(value, 0))


class AgmSemantics(NumpySemantics):
    """Agm robustness of every operator."""

    def __init__(self, metric: Agm) -> None:
        self.metric = metric

    def opposite(self) -> AgmSemantics:
        return self

    def truth(self, like: FloatArray, steps: int) -> FloatArray:
        return self.constant(1.0, like, steps)

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:
        low, high = margin_range(predicate, self.metric.bounds)
        if low == high:  # no signal has a say: as true and false
            return np.sign(margin)
        if self.metric.clip:
            margin = _clip(predicate, margin, low, high)
        return margin / (high - low)

    def negate(self, value: FloatArray) -> FloatArray:
        return -value

    def conjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return _mean_over_last(np.stack(values, axis=-1), ties_fail=True)

    def disjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return -_mean_over_last(-np.stack(values, axis=-1), ties_fail=False)

    def always(self, value: FloatArray, width: int) -> FloatArray:
        return _mean_over_windows(value, width, ties_fail=True)

    def eventually(self, value: FloatArray, width: int) -> FloatArray:
        return -_mean_over_windows(-value, width, ties_fail=False)

    def until(self, left: FloatArray, right: FloatArray, first: int, last: int) -> FloatArray:
        width = last - first + 1
        left_windows = sliding_window_view(left, last + 1, axis=-1)
        right_windows = sliding_window_view(right, width, axis=-1)
        result = np.empty(left_windows.shape[:2])
        for chunk in window_chunks(left_windows):
            held = _running_mean(left_windows[:, chunk])[..., first:]
            reached = self.conjunction([held, right_windows[:, chunk]])
            result[:, chunk] = -_mean_over_last(-reached, ties_fail=False)
        return result


def _clip(predicate: Predicate, margin: FloatArray, low: float, high: float) -> FloatArray:
    clipped = np.clip(margin, low, high)
    flipped = (np.sign(clipped) != np.sign(margin)).any()
    if flipped:
        raise InputError(
            f"agm: clipping to the bounds would change whether '{predicate}' holds, whose margin"
            f" has the range [{low:g}, {high:g}]; declare wider bounds"
        )
    return clipped


def _conclude(means: Means, count: FloatArray | int, *, ties_fail: bool) -> FloatArray:
    """The conjunction of ``count`` values; ``ties_fail``: whether a value of 0 fails."""
    fails = means.least <= 0.0 if ties_fail else means.least < 0.0
    return np.where(fails, means.failing / count, np.expm1(means.growth / count))


def _mean_over_last(values: FloatArray, *, ties_fail: bool) -> FloatArray:
    """Conjunction over the last axis, [..., m] -> [...]."""
    means = Means(
        least=values.min(axis=-1),
        failing=np.minimum(values, 0.0).sum(axis=-1),
        growth=np.log1p(np.maximum(values, 0.0)).sum(axis=-1),
    )
    return _conclude(means, values.shape[-1], ties_fail=ties_fail)


def _mean_over_windows(values: FloatArray, width: int, *, ties_fail: bool) -> FloatArray:
    """Conjunction over every window of ``width`` steps, [n, s] -> [n, s - width + 1]."""
    if values.shape[-1] == width:
        return _mean_over_last(values, ties_fail=ties_fail)[:, np.newaxis]
    parts = (values, np.minimum(values, 0.0), np.log1p(np.maximum(values, 0.0)))
    return _conclude(Means(*sliding(_join, parts, width)), width, ties_fail=ties_fail)


def _join(earlier: tuple[FloatArray, ...], later: tuple[FloatArray, ...]) -> Means:
    return Means(np.minimum(earlier[0], later[0]), earlier[1] + later[1], earlier[2] + later[2])


def _running_mean(values: FloatArray) -> FloatArray:
    """Conjunction of the first 1, 2, ... values of the last axis."""
    means = Means(
        least=np.minimum.accumulate(values, axis=-1),
        failing=np.add.accumulate(np.minimum(values, 0.0), axis=-1),
        growth=np.add.accumulate(np.log1p(np.maximum(values, 0.0)), axis=-1),
    )
    return _conclude(means, np.arange(1, values.shape[-1] + 1), ties_fail=True)
