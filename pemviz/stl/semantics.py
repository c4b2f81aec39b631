"""The walk over a formula that every metric shares.

A metric says what happens at each operator (`Semantics`); `evaluate` says which
steps of which part are needed. Arrays may be numpy's or torch's; time comes first, [steps, n],
so that what happens at a step happens to all rollouts at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from typing import Any, Protocol, TypeVar

from pemviz.stl import expressions as ex
from pemviz.stl.expressions import Predicate
from pemviz.stl.formulas import And, Formula, Implies, Not, Or, Truth
from pemviz.stl.temporal import Always, Eventually, Until

ArrayT = TypeVar("ArrayT")


class Semantics(Protocol[ArrayT]):
    """What one metric makes of every operator; all arrays are [steps, n].

    Values and margins that are handed to an operator are its own to overwrite.
    """

    def opposite(self) -> Semantics[ArrayT]:
        """The semantics under a negation (differs where positive and negative part do)."""
        ...

    def minimum(self, left: ArrayT, right: ArrayT) -> ArrayT:
        """Elementwise minimum of numbers (not of formulas)."""
        ...

    def maximum(self, left: ArrayT, right: ArrayT) -> ArrayT:
        """Elementwise maximum of numbers (not of formulas)."""
        ...

    def constant(self, value: float, like: ArrayT, steps: int) -> ArrayT:
        """``value`` at ``steps`` steps of every rollout of ``like``."""
        ...

    def truth(self, like: ArrayT, steps: int) -> ArrayT:
        """``true`` at ``steps`` steps of every rollout of ``like``."""
        ...

    def predicate(self, predicate: Predicate, margin: ArrayT) -> ArrayT:
        """The value of a predicate that holds by ``margin`` (negative: fails by it)."""
        ...

    def negate(self, value: ArrayT) -> ArrayT:
        """``not``, of a value that `opposite` semantics gave."""
        ...

    def conjunction(self, values: Sequence[ArrayT]) -> ArrayT:
        """``and`` of several values at the same steps."""
        ...

    def disjunction(self, values: Sequence[ArrayT]) -> ArrayT:
        """``or`` of several values at the same steps."""
        ...

    def always(self, value: ArrayT, width: int) -> ArrayT:
        """``always`` over every window of ``width`` steps: [steps - width + 1, n]."""
        ...

    def always_predicate(self, predicate: Predicate, margin: ArrayT, width: int) -> ArrayT:
        """`always` of `predicate`, for which some metrics have a shorter way."""
        ...

    def eventually(self, value: ArrayT, width: int) -> ArrayT:
        """``eventually`` over every window of ``width`` steps: [steps - width + 1, n]."""
        ...

    def until(self, left: ArrayT, right: ArrayT, first: int, last: int) -> ArrayT:
        """``until`` over [first, last].

        Args:
            left: [steps + last, n], from the first step on.
            right: [steps + last - first, n], from ``first`` steps later on.
            first: start of the interval.
            last: end of the interval, inclusive.

        Returns:
            [steps, n].
        """
        ...


def evaluate(  # noqa: PLR0911 (one case per operator)
    formula: Formula,
    semantics: Semantics[ArrayT],
    signals: Mapping[str, ArrayT],
    *,
    start: int,
    steps: int,
) -> ArrayT:
    """Value of ``formula`` at steps ``start .. start + steps - 1``, [steps, n].

    Args:
        formula: its horizon must fit behind the last of these steps.
        semantics: the metric.
        signals: arrays [T, n] by name, at least one (it gives n).
        start: first step.
        steps: number of steps.

    Raises:
        TypeError: a kind of formula that this function does not know.
    """

    def value(part: Formula, first: int = start, count: int = steps) -> ArrayT:
        return evaluate(part, semantics, signals, start=first, steps=count)

    def negated(part: Formula) -> ArrayT:
        opposite = semantics.opposite()
        return semantics.negate(evaluate(part, opposite, signals, start=start, steps=steps))

    match formula:
        case Truth():
            return semantics.truth(next(iter(signals.values())), steps)
        case Predicate():
            by = margin(formula, semantics, signals, start=start, steps=steps)
            return semantics.predicate(formula, by)
        case Not(operand=operand):
            return negated(operand)
        case And(parts=parts):
            return semantics.conjunction([value(part) for part in parts])
        case Or(parts=parts):
            return semantics.disjunction([value(part) for part in parts])
        case Implies(premise=premise, conclusion=conclusion):
            return semantics.disjunction([negated(premise), value(conclusion)])
        case Always(operand=Predicate() as operand, first=first, width=width):
            count = steps + width - 1
            by = margin(operand, semantics, signals, start=start + first, steps=count)
            return semantics.always_predicate(operand, by, width)
        case Always(operand=operand, first=first, width=width):
            return semantics.always(value(operand, start + first, steps + width - 1), width)
        case Eventually(operand=operand, first=first, width=width):
            return semantics.eventually(value(operand, start + first, steps + width - 1), width)
        case Until(left=left, right=right, first=first, last=last):
            before = value(left, start, steps + last)
            target = value(right, start + first, steps + last - first)
            return semantics.until(before, target, first, last)
        case _:
            raise TypeError(f"unknown formula {type(formula).__name__}")


def margin(
    predicate: Predicate,
    semantics: Semantics[ArrayT],
    signals: Mapping[str, ArrayT],
    *,
    start: int,
    steps: int,
) -> ArrayT:
    """By how much ``predicate`` holds (negative: fails) at each of the steps, [steps, n]."""
    left = _number(predicate.left, semantics, signals, start, steps)
    right = _number(predicate.right, semantics, signals, start, steps)
    by = left - right if predicate.is_lower_bound else right - left
    if isinstance(by, float):
        return semantics.constant(by, next(iter(signals.values())), steps)
    return by


def _number(  # noqa: PLR0911 (one case per kind of expression)
    expression: ex.Expression,
    semantics: Semantics[Any],
    signals: Mapping[str, Any],
    start: int,
    steps: int,
) -> Any:
    """[steps, n], or a float where no signal is involved."""

    def number(part: ex.Expression) -> Any:
        return _number(part, semantics, signals, start, steps)

    match expression:
        case ex.Constant(value=value):
            return value
        case ex.Signal(name=name):
            return signals[name][start : start + steps]
        case ex.Sum(left=left, right=right):
            return number(left) + number(right)
        case ex.Difference(left=left, right=right):
            return number(left) - number(right)
        case ex.Product(left=left, right=right):
            return number(left) * number(right)
        case ex.Quotient(left=left, right=right):
            return _quotient(number(left), number(right))
        case ex.Negative(operand=operand):
            return -number(operand)
        case ex.Absolute(operand=operand):
            return abs(number(operand))
        case ex.Minimum(operands=operands):
            return _extreme(semantics.minimum, min, [number(operand) for operand in operands])
        case ex.Maximum(operands=operands):
            return _extreme(semantics.maximum, max, [number(operand) for operand in operands])
        case _:
            raise TypeError(f"unknown expression {type(expression).__name__}")


def _extreme(
    of_arrays: Callable[[Any, Any], Any],
    of_floats: Callable[[Iterable[float]], float],
    values: list[Any],
) -> Any:
    if all(isinstance(value, float) for value in values):
        return of_floats(values)
    return reduce(of_arrays, values)


def _quotient(left: Any, right: Any) -> Any:
    # Arrays divide by zero quietly; so must plain numbers, for one error to tell of both.
    if isinstance(left, float) and isinstance(right, float) and right == 0.0:
        return math.nan
    return left / right
