"""The range of a predicate's margin, by interval arithmetic on the signals' bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from pemviz.errors import InputError
from pemviz.stl import expressions as ex
from pemviz.stl.errors import shorten
from pemviz.stl.expressions import Predicate

Interval: TypeAlias = tuple[float, float]


def check_interval(name: str, pair: Sequence[float]) -> Interval:
    """``pair`` as (low, high).

    Raises:
        InputError: not two finite numbers with low < high.
    """
    try:
        low, high = (float(value) for value in pair)
    except (TypeError, ValueError):
        raise InputError(f"bounds of signal {name!r}: {pair!r} is no pair (low, high)") from None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(f"bounds of signal {name!r}: ({low}, {high}) must be finite, low < high")
    return low, high


def margin_range(predicate: Predicate, bounds: Mapping[str, Interval]) -> Interval:
    """The (low, high) between which the margin of ``predicate`` lies.

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
    expression: ex.Expression, bounds: Mapping[str, Interval]
) -> Interval:
    match expression:
        case ex.Constant(value=value):
            return value, value
        case ex.Signal(name=name):
            if name not in bounds:
                declared = ", ".join(sorted(bounds)) or "none"
                raise InputError(f"agm: no bounds for signal {name!r}; declared: {declared}")
            return bounds[name]
        case ex.Negative(operand=operand):
            low, high = _range(operand, bounds)
            return -high, -low
        case ex.Absolute(operand=operand):
            low, high = _range(operand, bounds)
            return max(0.0, low, -high), max(-low, high)
        case ex.Minimum(operands=operands) | ex.Maximum(operands=operands):
            extreme = min if isinstance(expression, ex.Minimum) else max
            lows, highs = zip(*(_range(operand, bounds) for operand in operands), strict=True)
            return extreme(lows), extreme(highs)
        case ex.Sum(left=left, right=right):
            a, b = _range(left, bounds), _range(right, bounds)
            return a[0] + b[0], a[1] + b[1]
        case ex.Difference(left=left, right=right):
            a, b = _range(left, bounds), _range(right, bounds)
            return a[0] - b[1], a[1] - b[0]
        case ex.Product(left=left, right=right):
            return _product(_range(left, bounds), _range(right, bounds))
        case ex.Quotient(left=left, right=right):
            divisor = _range(right, bounds)
            if divisor[0] <= 0.0 <= divisor[1]:
                raise InputError(
                    f"agm: '{shorten(right)}' can be 0 within the declared bounds, as a divisor"
                )
            return _product(_range(left, bounds), (1.0 / divisor[1], 1.0 / divisor[0]))
        case _:
            raise TypeError(f"unknown expression {type(expression).__name__}")


def _product(left: Interval, right: Interval) -> Interval:
    products = [a * b for a in left for b in right]
    return min(products), max(products)
