"""Smooth cumulative robustness: Haghighi, Mehdipour, Bartocci & Belta, CDC 2019.

Two parts, neither the negative of the other: the positive part adds up how much and
for how long a formula holds, the negative part how much it fails. The positive part of
``always f`` is <= 0 exactly when sum_t sigmoid(-beta f_t) >= 1, so it ranks rollouts
and never decides a violation.
"""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pemviz.arrays import FloatArray
from pemviz.errors import InputError
from pemviz.stl.formulas import Predicate
from pemviz.stl.numpy_base import NumpySemantics, window_chunks
from pemviz.stl.windows import sliding

Part: TypeAlias = Literal["positive", "negative"]


@dataclass(frozen=True)
class SmoothCumulative:
    """The smooth cumulative metric, in the unit of the predicates.

    Attributes:
        beta: sharpness, > 0, per unit of the predicates (per metre).
        part: which of the two parts.
    """

    beta: float = 75.0
    part: Part = "positive"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.beta) and self.beta > 0.0):
            raise InputError(f"smooth-cumulative: beta {self.beta} must be finite and > 0")
        if self.part not in ("positive", "negative"):
            raise InputError(f"smooth-cumulative: part {self.part!r}: positive or negative")

    def opposite(self) -> SmoothCumulative:
        """The same metric's other part."""
        return SmoothCumulative(self.beta, "negative" if self.part == "positive" else "positive")


class SmoothCumulativeSemantics(NumpySemantics):
    """One part of the smooth cumulative robustness of every operator."""

    def __init__(self, metric: SmoothCumulative) -> None:
        self.metric = metric
        self.sign = 1.0 if metric.part == "positive" else -1.0

    def opposite(self) -> SmoothCumulativeSemantics:
        return SmoothCumulativeSemantics(self.metric.opposite())

    def truth(self, like: FloatArray, steps: int) -> FloatArray:
        return self.constant(math.inf if self.sign > 0.0 else 0.0, like, steps)

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:  # noqa: ARG002
        return self.sign * _softplus(self.sign * margin, self.metric.beta)

    def negate(self, value: FloatArray) -> FloatArray:
        return -value

    def conjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return _soft_minimum(np.stack(values, axis=-1), self.metric.beta)

    def disjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return -_soft_minimum(-np.stack(values, axis=-1), self.metric.beta)

    def always(self, value: FloatArray, width: int) -> FloatArray:
        if value.shape[-1] == width:
            return _soft_minimum(value, self.metric.beta)[:, np.newaxis]
        return _sliding_soft_minimum(value, self.metric.beta, width)

    def eventually(self, value: FloatArray, width: int) -> FloatArray:
        if value.shape[-1] == width:
            return value.sum(axis=-1, keepdims=True)
        return sliding(_add, (value,), width)[0]

    def until(self, left: FloatArray, right: FloatArray, first: int, last: int) -> FloatArray:
        beta, width = self.metric.beta, last - first + 1
        left_windows = sliding_window_view(left, last + 1, axis=-1)
        right_windows = sliding_window_view(right, width, axis=-1)
        result = np.empty(left_windows.shape[:2])
        for chunk in window_chunks(left_windows):
            logits = np.logaddexp.accumulate(-beta * left_windows[:, chunk], axis=-1)[..., first:]
            met = np.logaddexp(-beta * right_windows[:, chunk], logits)
            result[:, chunk] = (met / -beta).sum(axis=-1)
        return result


def _softplus(values: FloatArray, beta: float) -> FloatArray:
    """log(1 + exp(beta x)) / beta, without overflow."""
    return np.maximum(values, 0.0) + np.log1p(np.exp(-beta * np.abs(values))) / beta


def _soft_minimum(values: FloatArray, beta: float) -> FloatArray:
    """-log(sum exp(-beta x)) / beta over the last axis, shifted by the minimum."""
    least = values.min(axis=-1, keepdims=True)
    shift = np.where(np.isfinite(least), least, 0.0)
    total = np.exp(-beta * (values - shift)).sum(axis=-1)
    return shift[..., 0] - np.log(total) / beta


def _sliding_soft_minimum(values: FloatArray, beta: float, width: int) -> FloatArray:
    """`_soft_minimum` of every window: pairs (shift, sum of exponentials) are combined."""

    def join(
        earlier: tuple[FloatArray, ...], later: tuple[FloatArray, ...]
    ) -> tuple[FloatArray, FloatArray]:
        shift = np.minimum(earlier[0], later[0])
        return shift, (
            earlier[1] * np.exp(-beta * (earlier[0] - shift))
            + later[1] * np.exp(-beta * (later[0] - shift))
        )

    # Infinite values (from `true`) would meet as inf - inf: they go into the sum instead.
    total = np.where(np.isposinf(values), 0.0, np.where(np.isneginf(values), np.inf, 1.0))
    shift, total = sliding(join, (np.clip(values, -_HUGE, _HUGE), total), width)
    return shift - np.log(total) / beta


_HUGE = 1e300


def _add(earlier: tuple[FloatArray, ...], later: tuple[FloatArray, ...]) -> tuple[FloatArray]:
    return (earlier[0] + later[0],)
