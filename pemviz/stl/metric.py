"""What a metric makes of every operator, and the walk over a formula that all metrics share.

`evaluate` says which steps of which part are needed. Arrays have time first, [steps, n], so that
what happens at a step happens to all rollouts at once. Values are combined over stretches of time
by doubling: an associative ``combine`` is applied to all windows of ``width`` consecutive steps in
about log2(width) passes over the data, instead of ``width`` passes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from itertools import pairwise
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.stl import formulas as fo
from pemviz.stl.formulas import Expression, Formula, Predicate

Parts = tuple[FloatArray, ...]
Combine = Callable[[Parts, Parts], Parts]


class Metric(ABC):
    """What one metric makes of every operator; all arrays are [steps, n].

    Values and margins that are handed to an operator are its own to overwrite.
    """

    def opposite(self) -> Metric:
        """The metric under a negation (differs where positive and negative part do)."""
        return self

    @abstractmethod
    def truth(self) -> float:
        """``true``, at any step."""

    @abstractmethod
    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:
        """The value of a predicate that holds by ``margin`` (negative: fails by it)."""

    @abstractmethod
    def conjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        """``and`` of several values at the same steps."""

    def disjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        """``or`` of several values at the same steps."""
        return -self.conjunction([-value for value in values])

    @abstractmethod
    def always(self, value: FloatArray, width: int) -> FloatArray:
        """``always`` over every window of ``width`` steps: [steps - width + 1, n]."""

    def always_predicate(self, predicate: Predicate, margin: FloatArray, width: int) -> FloatArray:
        """`always` of `predicate`, for which some metrics have a shorter way."""
        return self.always(self.predicate(predicate, margin), width)

    def eventually(self, value: FloatArray, width: int) -> FloatArray:
        """``eventually`` over every window of ``width`` steps: [steps - width + 1, n]."""
        return -self.always(-value, width)

    @abstractmethod
    def until(self, left: FloatArray, right: FloatArray, first: int, last: int) -> FloatArray:
        """``until`` over [first, last], inclusive: [steps, n].

        ``left`` is [steps + last, n], from the first step on, and ``right``
        [steps + last - first, n], from ``first`` steps later on.
        """


def evaluate(  # noqa: PLR0911 (one case per operator)
    formula: Formula,
    metric: Metric,
    signals: Mapping[str, FloatArray],
    *,
    start: int = 0,
    steps: int = 1,
) -> FloatArray:
    """Value of ``formula`` at steps ``start .. start + steps - 1``, [steps, n].

    The formula's horizon must fit behind the last of these steps; ``signals`` are arrays [T, n] by
    name, at least one (it gives n).

    Raises:
        TypeError: a kind of formula that this function does not know.
    """

    def value(part: Formula, ahead: int = 0, more: int = 0) -> FloatArray:
        return evaluate(part, metric, signals, start=start + ahead, steps=steps + more)

    def negated(part: Formula) -> FloatArray:
        return -evaluate(part, metric.opposite(), signals, start=start, steps=steps)

    match formula:
        case fo.Truth():
            return np.full((steps, next(iter(signals.values())).shape[1]), metric.truth())
        case Predicate():
            return metric.predicate(formula, margin(formula, signals, start=start, steps=steps))
        case fo.Not(operand=operand):
            return negated(operand)
        case fo.And(parts=parts):
            return metric.conjunction([value(part) for part in parts])
        case fo.Or(parts=parts):
            return metric.disjunction([value(part) for part in parts])
        case fo.Implies(premise=premise, conclusion=conclusion):
            return metric.disjunction([negated(premise), value(conclusion)])
        case fo.Always(operand=Predicate() as operand, first=first, width=width):
            by = margin(operand, signals, start=start + first, steps=steps + width - 1)
            return metric.always_predicate(operand, by, width)
        case fo.Always(operand=operand, first=first, width=width):
            return metric.always(value(operand, first, width - 1), width)
        case fo.Eventually(operand=operand, first=first, width=width):
            return metric.eventually(value(operand, first, width - 1), width)
        case fo.Until(left=left, right=right, first=first, last=last):
            before, target = value(left, 0, last), value(right, first, last - first)
            return metric.until(before, target, first, last)
        case _:
            raise TypeError(f"unknown formula {type(formula).__name__}")


def margin(
    predicate: Predicate, signals: Mapping[str, FloatArray], *, start: int, steps: int
) -> FloatArray:
    """By how much ``predicate`` holds (negative: fails) at each of the steps, [steps, n]."""
    left = _number(predicate.left, signals, slice(start, start + steps))
    right = _number(predicate.right, signals, slice(start, start + steps))
    by = left - right if predicate.is_lower_bound else right - left
    if isinstance(by, float):
        return np.full((steps, next(iter(signals.values())).shape[1]), by)
    return by


def _number(  # noqa: PLR0911 (one case per kind of expression)
    expression: Expression, signals: Mapping[str, Any], rows: slice
) -> Any:
    """[steps, n], or a float where no signal is involved."""

    def number(part: Expression) -> Any:
        return _number(part, signals, rows)

    match expression:
        case fo.Constant(value=value):
            return value
        case fo.Signal(name=name):
            return signals[name][rows]
        case fo.Sum(left=left, right=right):
            return number(left) + number(right)
        case fo.Difference(left=left, right=right):
            return number(left) - number(right)
        case fo.Product(left=left, right=right):
            return number(left) * number(right)
        case fo.Quotient(left=left, right=right):
            over, under = number(left), number(right)
            # Arrays divide by zero quietly; so must plain numbers, for one error to tell of both.
            if isinstance(over, float) and isinstance(under, float) and under == 0.0:
                return math.nan
            return over / under
        case fo.Negative(operand=operand):
            return -number(operand)
        case fo.Absolute(operand=operand):
            return abs(number(operand))
        case fo.Minimum(operands=operands) | fo.Maximum(operands=operands):
            is_minimum = isinstance(expression, fo.Minimum)
            values = [number(operand) for operand in operands]
            if all(isinstance(value, float) for value in values):
                return min(values) if is_minimum else max(values)
            return reduce(np.minimum if is_minimum else np.maximum, values)
        case _:
            raise TypeError(f"unknown expression {type(expression).__name__}")


def elementwise(ufunc: Callable[..., Any]) -> Combine:
    """What `sliding` takes, for one array and a function of two."""
    return lambda earlier, later: (ufunc(earlier[0], later[0]),)


def sliding(combine: Combine, parts: Parts, width: int) -> Parts:
    """``combine`` over every window, each step counted exactly once.

    Args:
        combine: associative; its left argument is the earlier stretch of time.
        parts: arrays [T, ...] that together describe each step.
        width: steps in a window, 1 <= width <= T.

    Returns:
        Arrays [T - width + 1, ...].
    """
    steps = len(parts[0]) - width + 1
    result: Parts | None = None
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


def sliding_idempotent(combine: Combine, parts: Parts, width: int) -> Parts:
    """As `sliding`, where counting a step twice changes nothing (minimum): fewer passes."""
    steps = len(parts[0]) - width + 1
    stretch = 1
    while 2 * stretch <= width:
        parts = _doubled(combine, parts, stretch)
        stretch *= 2
    if stretch == width:
        return _from(parts, 0, steps)
    return combine(_from(parts, 0, steps), _from(parts, width - stretch, steps))


def _from(parts: Parts, start: int, steps: int) -> Parts:
    return tuple(part[start : start + steps] for part in parts)


def _doubled(combine: Combine, parts: Parts, stretch: int) -> Parts:
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
