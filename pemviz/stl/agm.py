"""Arithmetic-geometric mean robustness: Mehdipour, Vasile & Belta, ACC 2019.

Dimensionless: a predicate's margin is divided by the width of its range, computed from
declared bounds of the signals. The metric is discontinuous where a margin is exactly 0. There a
disjunction is the dual of the conjunction: 0 if its best part is exactly 0, so that the sign is
that of classical robustness everywhere (as published it would be negative).
"""

# ruff: noqa: D102 (the operators are described by Metric)

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TypeAlias

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import InputError
from pemviz.stl import formulas as fo
from pemviz.stl.formulas import Expression, Predicate, shorten
from pemviz.stl.metric import Metric, fold, half_of, running, sliding

Interval: TypeAlias = tuple[float, float]


@dataclass(frozen=True)
class Agm(Metric):
    """The arithmetic-geometric mean metric.

    Attributes:
        bounds: (low, high) of every signal that a formula uses, in the signal's unit.
        clip: whether values beyond their bounds count as the bound; otherwise they
            are an error.
    """

    bounds: Mapping[str, Interval]
    clip: bool = False

    def __post_init__(self) -> None:
        checked = {name: _checked(name, pair) for name, pair in self.bounds.items()}
        object.__setattr__(self, "bounds", checked)

    def __hash__(self) -> int:
        return hash((frozenset(self.bounds.items()), self.clip))

    def truth(self) -> float:
        return 1.0

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:
        low, high = margin_range(predicate, self.bounds)
        if low == high:  # no signal has a say: as true and false
            return np.sign(margin)
        if self.clip:
            clipped = np.clip(margin, low, high)
            if (np.sign(clipped) != np.sign(margin)).any():
                raise InputError(
                    f"agm: clipping to the bounds would change whether '{shorten(predicate)}'"
                    f" holds, whose margin has the range [{low:g}, {high:g}]; declare wider bounds"
                )
            margin = clipped
        margin *= 1.0 / (high - low)
        return margin

    def conjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return _conclude(reduce(_join, [_means(value) for value in values]), len(values))

    def always(self, value: FloatArray, width: int) -> FloatArray:
        if len(value) > width:
            return _conclude(sliding(_join, _means(value), width), width)
        least = value.min(axis=0, keepdims=True)
        failing = fold(np.add, np.minimum(value, 0.0))
        growth = fold(np.add, np.log1p(_compound(value)))
        return _conclude((least, failing, growth), width)

    def until(self, left: FloatArray, right: FloatArray, first: int, last: int) -> FloatArray:
        steps, width = len(left) - last, last - first + 1
        if steps == 1:
            least, failing, growth = _means(left)
            means = running(np.minimum, least), running(np.add, failing), running(np.add, growth)
            counts = np.arange(1.0, len(left) + 1.0)[:, None]
            met = self.conjunction([right, _conclude(means, counts)[first:]])
            return self.eventually(met, width)
        shape = steps, left.shape[1]
        held = failed = (np.full(shape, math.inf), np.zeros(shape), np.zeros(shape))
        for offset in range(last + 1):
            held = _join(held, _means(left[offset : offset + steps]))
            if offset >= first:
                so_far = _conclude(held, offset + 1)
                target = right[offset - first : offset - first + steps]
                failed = _join(failed, _means(-self.conjunction([target, so_far])))
        return -_conclude(failed, width)


def _checked(name: str, pair: Sequence[float]) -> Interval:
    try:
        low, high = (float(value) for value in pair)
    except (TypeError, ValueError):
        raise InputError(f"bounds of signal {name!r}: {pair!r} is no pair (low, high)") from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(f"bounds of signal {name!r}: ({low}, {high}) must be finite, low < high")
    return low, high


Means: TypeAlias = tuple[FloatArray, ...]
"""What the conjunction of several values depends on, each [steps, n].

The least value; the sum of min(value, 0); the sum of log(1 + value), which only counts
(and may be NaN otherwise) where no value is negative. Sums of one sign only, so that no
digits cancel.
"""


def _means(values: FloatArray) -> Means:
    return values, np.minimum(values, 0.0), np.log1p(values)


def _join(earlier: Means, later: Means) -> Means:
    return np.minimum(earlier[0], later[0]), earlier[1] + later[1], earlier[2] + later[2]


def _conclude(means: Means, count: int | FloatArray) -> FloatArray:
    """The conjunction of ``count`` values."""
    least, failing, growth = means
    return np.where(least <= 0.0, failing / count, np.expm1(growth / count))


HALVINGS = 4
"""Before logarithms are taken, so that one serves up to 16 steps."""


def _compound(values: FloatArray) -> FloatArray:
    """prod(1 + value) - 1 over groups of steps, [s, n] -> [groups, n], in place.

    To full accuracy where all values are positive. The steps are folded as by `fold`.
    """
    for _ in range(HALVINGS):
        if len(values) > 1:
            half = half_of(len(values))
            left, right = values[: len(values) - half], values[half:]
            product = left * right
            left += product
            left += right
            values = values[:half]
    return values


def margin_range(predicate: Predicate, bounds: Mapping[str, Interval]) -> Interval:
    """The (low, high) between which the margin of ``predicate`` lies, by interval arithmetic.

    Raises:
        InputError: a signal has no bounds, or a divisor's range contains 0.
    """
    left, right = _range(predicate.left, bounds), _range(predicate.right, bounds)
    if not predicate.is_lower_bound:
        left, right = right, left
    low, high = left[0] - right[1], left[1] - right[0]
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InputError(
            f"agm: the range of '{shorten(predicate)}' within the declared bounds is infinite"
        )
    return low, high


def _range(  # noqa: PLR0911 (one case per kind of expression)
    expression: Expression, bounds: Mapping[str, Interval]
) -> Interval:
    match expression:
        case fo.Constant(value=value):
            return value, value
        case fo.Signal(name=name):
            if name not in bounds:
                declared = ", ".join(sorted(bounds)) or "none"
                raise InputError(f"agm: no bounds for signal {name!r}; declared: {declared}")
            return bounds[name]
        case fo.Negative(operand=operand):
            low, high = _range(operand, bounds)
            return -high, -low
        case fo.Absolute(operand=operand):
            low, high = _range(operand, bounds)
            return max(0.0, low, -high), max(-low, high)
        case fo.Minimum(operands=operands) | fo.Maximum(operands=operands):
            extreme = min if isinstance(expression, fo.Minimum) else max
            lows, highs = zip(*(_range(operand, bounds) for operand in operands), strict=True)
            return extreme(lows), extreme(highs)
        case fo.Sum(left=left, right=right):
            a, b = _range(left, bounds), _range(right, bounds)
            return a[0] + b[0], a[1] + b[1]
        case fo.Difference(left=left, right=right):
            a, b = _range(left, bounds), _range(right, bounds)
            return a[0] - b[1], a[1] - b[0]
        case fo.Product(left=left, right=right):
            return _product(_range(left, bounds), _range(right, bounds))
        case fo.Quotient(left=left, right=right):
            low, high = _range(right, bounds)
            if low <= 0.0 <= high:
                raise InputError(
                    f"agm: '{shorten(right)}' can be 0 within the declared bounds, as a divisor"
                )
            return _product(_range(left, bounds), (1.0 / high, 1.0 / low))
        case _:
            raise TypeError(f"unknown expression {type(expression).__name__}")


def _product(left: Interval, right: Interval) -> Interval:
    products = [a * b for a in left for b in right]
    return min(products), max(products)
