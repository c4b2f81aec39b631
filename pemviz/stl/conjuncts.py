"""Formulas that a formula is the conjunction of: each tells of another way to violate it.

``always`` and implication distribute over a conjunction, ``until`` is kept only if its right side
is ever reached, and ``abs(x) <= c`` bounds on two sides. What ``eventually`` demands fails over a
whole interval, and is one.
"""

from collections.abc import Sequence
from dataclasses import replace

from pemviz.stl import formulas as fo
from pemviz.stl.formulas import Expression, Formula

MOST = 6
"""Conjuncts of a formula; one that has more is left as it is at the level at which it has."""


def conjuncts(formula: Formula) -> tuple[Formula, ...]:
    """Formulas that hold, all of them, exactly where ``formula`` does; itself where there is one.

    Example:
        >>> from pemviz import stl
        >>> for one in stl.conjuncts(stl.parse("always[0,9] (gap > 2 and abs(offset) < 1)")):
        ...     print(one)
        always[0,9] (gap > 2.0)
        always[0,9] (offset < 1.0)
        always[0,9] (-offset < 1.0)
    """
    found, place = [formula], 0
    while place < len(found):
        try:
            parts = _parts(found[place], conjunction=True)
        except fo.FormulaError:  # nested as deeply as any may be
            parts = ()
        if parts and len(found) - 1 + len(parts) <= MOST:
            found[place : place + 1] = parts
        else:
            place += 1
    return tuple(found)


def _parts(formula: Formula, *, conjunction: bool) -> Sequence[Formula]:
    """Of its outermost conjunction, or else disjunction, that can be moved outward; else none."""
    parts: Sequence[Formula] = ()
    match formula:
        case fo.And() | fo.Or() if isinstance(formula, fo.And) == conjunction:
            parts = formula.parts
        case fo.And() | fo.Or():
            parts = _one_part(formula, conjunction=conjunction)
        case fo.Always() | fo.Eventually() if isinstance(formula, fo.Always) == conjunction:
            inner = _parts(formula.operand, conjunction=conjunction)
            parts = [replace(formula, operand=one) for one in inner]
        case fo.Not():
            inner = _parts(formula.operand, conjunction=not conjunction)
            parts = [fo.Not(one) for one in inner]
        case fo.Implies():
            parts = _of_implication(formula, conjunction=conjunction)
        case fo.Until() if conjunction:
            parts = [_reached(formula), fo.Implies(_reached(formula), formula)]
        case fo.Predicate():
            parts = _of_comparison(formula, conjunction=conjunction)
        case _:  # over a whole interval
            pass
    return parts


def _reached(formula: fo.Until) -> Formula:
    return fo.Eventually(formula.first, formula.last, formula.right)


def _of_implication(formula: fo.Implies, *, conjunction: bool) -> Sequence[Formula]:
    premise, conclusion = formula.premise, formula.conclusion
    if not conjunction:
        return [fo.Not(premise), conclusion]
    if isinstance(conclusion, fo.Until) and premise == _reached(conclusion):
        return ()  # what an until is left with
    parts = [fo.Implies(premise, one) for one in _parts(conclusion, conjunction=True)]
    return parts or [fo.Implies(one, conclusion) for one in _parts(premise, conjunction=False)]


def _one_part(formula: fo.And | fo.Or, *, conjunction: bool) -> Sequence[Formula]:
    """The others with each piece of the first part that can be taken apart."""
    for place, part in enumerate(formula.parts):
        before, after = formula.parts[:place], formula.parts[place + 1 :]
        pieces = _parts(part, conjunction=conjunction)
        if pieces:
            return [replace(formula, parts=(*before, one, *after)) for one in pieces]
    return ()


def _of_comparison(formula: fo.Predicate, *, conjunction: bool) -> Sequence[Formula]:
    """Of ``abs``, ``min`` and ``max`` on one of the sides."""
    largest = formula.is_lower_bound != conjunction
    left = _operands(formula.left, largest=largest)
    if left:
        return [replace(formula, left=one) for one in left]
    right = _operands(formula.right, largest=not largest)
    return [replace(formula, right=one) for one in right]


def _operands(number: Expression, *, largest: bool) -> Sequence[Expression]:
    """Numbers of which this one is the largest, or the smallest."""
    match number:
        case fo.Absolute() if largest:
            return (number.operand, fo.Negative(number.operand))
        case fo.Maximum() if largest:
            return number.operands
        case fo.Minimum() if not largest:
            return number.operands
        case _:
            return ()
