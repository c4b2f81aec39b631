"""Formulas written in Python: ``always(0, 99, signal("gap") >= 2.0)``."""

from __future__ import annotations

from pemviz.stl.expressions import Expression, Maximum, Minimum, Number, Signal, as_expression
from pemviz.stl.formulas import Formula, Truth
from pemviz.stl.temporal import Always, Eventually, Until

TRUE = Truth()


def signal(name: str) -> Signal:
    """The signal of that name, to be compared, added, and so on."""
    return Signal(name)


def minimum(*operands: Expression | Number) -> Minimum:
    """The least of several numbers, step by step."""
    return Minimum(tuple(as_expression(operand) for operand in operands))


def maximum(*operands: Expression | Number) -> Maximum:
    """The greatest of several numbers, step by step."""
    return Maximum(tuple(as_expression(operand) for operand in operands))


def always(first: int, last: int, operand: Formula) -> Always:
    """``operand`` at every step of [t + first, t + last]."""
    return Always(first, last, operand)


def eventually(first: int, last: int, operand: Formula) -> Eventually:
    """``operand`` at some step of [t + first, t + last]."""
    return Eventually(first, last, operand)


def until(left: Formula, first: int, last: int, right: Formula) -> Until:
    """``right`` at some t' in [t + first, t + last], ``left`` on all of [t, t']."""
    return Until(first, last, left, right)
