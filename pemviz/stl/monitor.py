"""Watching a formula while rollouts unfold: when is it broken whatever comes next?

Online monitoring by bounds (Deshmukh, Donze, Ghosh, Jin, Juniwal, Seshia 2017): what no state
has decided yet may turn out anything. Only whether each part holds is followed, strict comparisons
as they are written, so that the verdict at the end is that of :func:`pemviz.stl.violated` exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.stl.expressions import Predicate
from pemviz.stl.formulas import And, Formula, Implies, Not, Or, Truth
from pemviz.stl.semantics import margin
from pemviz.stl.temporal import Always, Eventually, Until
from pemviz.stl.verdict import BooleanSemantics

FAILS, HOLDS = -1, 1
SEMANTICS = BooleanSemantics()


@dataclass(frozen=True)
class Bounds:
    """What is known of one part of a formula at the steps at which it is needed.

    Attributes:
        lower: Whether it holds (1) or fails (-1) in its worst continuation, ``[steps, n]`` int8.
        upper: The same in its best one.
    """

    lower: AnyArray
    upper: AnyArray


Known = tuple[Bounds, ...]
"""Of every part of a formula, the whole last."""


@dataclass(frozen=True)
class _Part:
    """A part of a formula, and the steps that concern it.

    Attributes:
        formula: The part.
        children: Places of its own parts in the list.
        first: First step at which its value is needed.
        last: Last one.
        soonest: A state tells nothing about the part fewer than this many steps before it.
    """

    formula: Formula
    children: tuple[int, ...]
    first: int
    last: int
    soonest: int

    def touched(self, step: int) -> range:
        """The steps at which a state at ``step`` may change what is known of the part."""
        if isinstance(self.formula, Truth):
            return range(0)
        earliest = max(self.first, step - self.formula.horizon_steps())
        return range(earliest, min(self.last, step - self.soonest) + 1)


class FormulaMonitor:
    """Follows one formula, at step 0, over rollouts that unfold state by state.

    It keeps nothing between calls: what is known is handed out and taken back, and never
    changed, so that rollouts may be continued from anywhere.
    """

    def __init__(self, formula: Formula) -> None:
        """Prepare to watch ``formula``."""
        self._formula = formula
        self._parts = _parts(formula)

    def __eq__(self, other: object) -> bool:
        """Whether the other watches an equal formula."""
        return isinstance(other, FormulaMonitor) and self._formula == other._formula

    def __hash__(self) -> int:
        """As its formula's."""
        return hash(self._formula)

    def start(self, *, count: int) -> Known:
        """What is known of ``count`` rollouts before their first state."""
        return tuple(_unknown(part, count) for part in self._parts)

    def advance(self, known: Known, *, step: int, signals: Mapping[str, FloatArray]) -> Known:
        """What is known once the states of ``step`` are there as well.

        Args:
            known: What the states before told.
            step: Steps come one by one from 0.
            signals: ``[n]`` by name.
        """
        now = {n: np.asarray(v, dtype=np.float64)[np.newaxis] for n, v in signals.items()}
        result: list[Bounds] = []
        for part, before in zip(self._parts, known, strict=True):
            touched = part.touched(step)
            if not touched:
                result.append(before)
                continue
            children = [(self._parts[index], result[index]) for index in part.children]
            rows = slice(touched.start - part.first, touched.stop - part.first)
            lower, upper = before.lower.copy(), before.upper.copy()
            lower[rows], upper[rows] = _values(part.formula, children, touched, now)
            result.append(Bounds(lower, upper))
        return tuple(result)

    def violated(self, known: Known) -> BoolArray:
        """Which rollouts violate the formula whatever their further states, ``[n]``."""
        return known[-1].upper[0] < 0


def _unknown(part: _Part, count: int) -> Bounds:
    shape = (part.last - part.first + 1, count)
    sure = isinstance(part.formula, Truth)
    return Bounds(
        lower=np.full(shape, HOLDS if sure else FAILS, dtype=np.int8),
        upper=np.full(shape, HOLDS, dtype=np.int8),
    )


def _parts(formula: Formula, first: int = 0, last: int = 0, before: int = 0) -> tuple[_Part, ...]:
    """All parts, children first; ``before`` parts stand in the list already."""
    parts: list[_Part] = []
    children: list[int] = []
    soonest: list[int] = []
    for child, start, stop in _operands(formula):
        parts += _parts(child, first + start, last + stop, before + len(parts))
        children.append(before + len(parts) - 1)
        soonest.append(start + parts[-1].soonest)
    own = _Part(formula, tuple(children), first, last, min(soonest, default=0))
    return (*parts, own)


def _operands(formula: Formula) -> list[tuple[Formula, int, int]]:
    """The parts that are formulas, each with the steps ahead at which it is asked."""
    match formula:
        case Always(operand=operand) | Eventually(operand=operand):
            return [(operand, formula.first, formula.last)]
        case Until(left=left, right=right):
            return [(left, 0, formula.last), (right, formula.first, formula.last)]
        case _:
            return [(part, 0, 0) for part in formula.children() if isinstance(part, Formula)]


def _values(
    formula: Formula,
    children: list[tuple[_Part, Bounds]],
    touched: range,
    now: Mapping[str, FloatArray],
) -> tuple[AnyArray, AnyArray]:
    """Lower and upper values of a part at the steps ``touched``, from its parts' values."""
    if isinstance(formula, Predicate):
        with np.errstate(all="ignore"):  # what is not finite is reported where it is scored
            by = margin(formula, SEMANTICS, now, start=0, steps=1)
        holds = SEMANTICS.predicate(formula, by).astype(np.int8)
        return holds, holds
    lower = _combined(formula, children, touched, lambda bounds: (bounds.lower, bounds.upper))
    upper = _combined(formula, children, touched, lambda bounds: (bounds.upper, bounds.lower))
    return lower, upper


def _combined(  # noqa: PLR0911  one case per operator
    formula: Formula,
    children: list[tuple[_Part, Bounds]],
    touched: range,
    sides: Callable[[Bounds], tuple[AnyArray, AnyArray]],
) -> AnyArray:
    """One bound of a part; ``sides`` gives a child's like bound and its opposite one."""

    def value(
        index: int = 0, *, ahead: tuple[int, int] = (0, 0), negated: bool = False
    ) -> AnyArray:
        part, bounds = children[index]
        rows = slice(touched.start + ahead[0] - part.first, touched.stop + ahead[1] - part.first)
        return sides(bounds)[1 if negated else 0][rows].copy()  # operators may overwrite it

    match formula:
        case Not():
            return SEMANTICS.negate(value(negated=True))
        case And():
            return SEMANTICS.conjunction([value(index) for index in range(len(children))])
        case Or():
            return SEMANTICS.disjunction([value(index) for index in range(len(children))])
        case Implies():
            return SEMANTICS.disjunction([SEMANTICS.negate(value(0, negated=True)), value(1)])
        case Always(first=first, last=last, width=width):
            return SEMANTICS.always(value(ahead=(first, last)), width)
        case Eventually(first=first, last=last, width=width):
            return SEMANTICS.eventually(value(ahead=(first, last)), width)
        case Until(first=first, last=last):
            left, right = value(0, ahead=(0, last)), value(1, ahead=(first, last))
            return SEMANTICS.until(left, right, first, last)
        case _:
            message = f"unknown formula {type(formula).__name__}"
            raise TypeError(message)
