"""Whether a formula holds: its Boolean semantics, strict comparisons as they are written.

Classical robustness tells wherever it is not 0: above 0 the formula holds, below it fails (Donze &
Maler, FORMATS 2010, theorem 1; a difference of two doubles is 0 only if they are equal). At 0 some
comparison has equal sides, and whether it is strict decides.

While rollouts unfold, a formula is monitored by bounds (Deshmukh, Donze, Ghosh, Jin, Juniwal,
Seshia 2017): what no state has decided yet may turn out anything. Only whether each part holds is
followed, so that the verdict at the end is that of :func:`violated` exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.stl import formulas as fo
from pemviz.stl.classical import Classical
from pemviz.stl.evaluation import robustness, time_first
from pemviz.stl.formulas import Formula, Predicate
from pemviz.stl.metric import evaluate, margin


class Boolean(Classical):
    """1 where a part holds and -1 where it fails, by classical robustness' own operators."""

    def truth(self) -> float:
        """Holds."""
        return 1.0

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:
        """By its sign; of a tie, by whether the comparison is strict."""
        holds = margin > 0.0 if predicate.is_strict else margin >= 0.0
        return np.where(holds, 1.0, -1.0)


BOOLEAN = Boolean()


def violated(formula: Formula, signals: Mapping[str, AnyArray]) -> BoolArray:
    """Which rollouts violate the formula at step 0: the only thing that counts violations.

    Whatever metric ranks the rollouts, it is the formula's Boolean semantics that decides: at a
    margin of exactly 0 ``>=`` and ``<=`` hold, ``>`` and ``<`` fail. Takes and raises what
    :func:`pemviz.stl.robustness` does.

    Returns:
        ``[N]`` bool.

    Example:
        >>> import numpy as np
        >>> from pemviz import stl
        >>> touches = {"gap": np.array([[3.0, 2.0]])}
        >>> print(stl.violated(stl.parse("always[0,1] (gap >= 2.0)"), touches))
        [False]
        >>> print(stl.violated(stl.parse("always[0,1] (gap > 2.0)"), touches))
        [ True]
    """
    classical = robustness(formula, signals, Classical())
    fails = classical < 0.0
    if ties_hold(formula):
        return fails
    tied = np.flatnonzero(classical == 0.0)
    if tied.size:
        some = {n: time_first(np.asarray(signals[n])[tied]) for n in formula.signals() or signals}
        with np.errstate(all="ignore"):  # what is not finite was reported above
            fails[tied] = evaluate(formula, BOOLEAN, some)[0] < 0.0
    return fails


def ties_hold(formula: Formula) -> bool:
    """Whether the formula holds wherever its classical robustness is exactly 0.

    It does if every comparison with equal sides makes it hold sooner, as ``>=`` does, or ``>``
    under ``not``. Where it is not so, some ties may hold all the same.
    """
    return all(_ties(formula, negated=False))


def _ties(formula: Formula, *, negated: bool) -> Iterator[bool]:
    """Of each comparison: whether the whole formula holds sooner for its being equal."""
    if isinstance(formula, Predicate):
        yield formula.is_strict == negated
    for index, part in enumerate(formula.formulas()):
        negates = isinstance(formula, fo.Not) or (isinstance(formula, fo.Implies) and index == 0)
        yield from _ties(part, negated=negated != negates)


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
        if isinstance(self.formula, fo.Truth):
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
        known: list[Bounds] = []
        for part in self._parts:
            shape = (part.last - part.first + 1, count)
            holds = np.full(shape, 1, dtype=np.int8)
            known.append(Bounds(holds if isinstance(part.formula, fo.Truth) else -holds, holds))
        return tuple(known)

    def advance(self, known: Known, *, step: int, signals: Mapping[str, FloatArray]) -> Known:
        """What is known once the states of ``step`` are there as well.

        Args:
            known: After the states before.
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
            if isinstance(part.formula, Predicate):
                with np.errstate(all="ignore"):  # what is not finite is reported where it is scored
                    by = margin(part.formula, now, start=0, steps=1)
                lower[rows] = upper[rows] = BOOLEAN.predicate(part.formula, by)
            else:
                lower[rows] = _bound(part.formula, children, touched, upper=False)
                upper[rows] = _bound(part.formula, children, touched, upper=True)
            result.append(Bounds(lower, upper))
        return tuple(result)

    def violated(self, known: Known) -> BoolArray:
        """Which rollouts violate the formula whatever their further states, ``[n]``."""
        return known[-1].upper[0] < 0


def _parts(formula: Formula, first: int = 0, last: int = 0, before: int = 0) -> tuple[_Part, ...]:
    """All parts, children first; ``before`` parts stand in the list already."""
    match formula:  # the steps ahead at which its parts are evaluated
        case fo.Always() | fo.Eventually():
            ahead = [(formula.first, formula.last)]
        case fo.Until():
            ahead = [(0, formula.last), (formula.first, formula.last)]
        case _:
            ahead = [(0, 0)] * len(formula.formulas())
    parts: list[_Part] = []
    children: list[int] = []
    soonest: list[int] = []
    for child, (start, stop) in zip(formula.formulas(), ahead, strict=True):
        parts += _parts(child, first + start, last + stop, before + len(parts))
        children.append(before + len(parts) - 1)
        soonest.append(start + parts[-1].soonest)
    own = _Part(formula, tuple(children), first, last, min(soonest, default=0))
    return (*parts, own)


def _bound(  # noqa: PLR0911  one case per operator
    formula: Formula, children: list[tuple[_Part, Bounds]], touched: range, *, upper: bool
) -> AnyArray:
    """One bound of a part at the steps ``touched``, from its parts' bounds."""

    def value(
        index: int = 0, *, ahead: tuple[int, int] = (0, 0), negated: bool = False
    ) -> AnyArray:
        part, bounds = children[index]
        side = bounds.upper if upper != negated else bounds.lower
        rows = slice(touched.start + ahead[0] - part.first, touched.stop + ahead[1] - part.first)
        return -side[rows] if negated else side[rows].copy()  # operators may overwrite it

    match formula:
        case fo.Not():
            return value(negated=True)
        case fo.And():
            return BOOLEAN.conjunction([value(index) for index in range(len(children))])
        case fo.Or():
            return BOOLEAN.disjunction([value(index) for index in range(len(children))])
        case fo.Implies():
            return BOOLEAN.disjunction([value(0, negated=True), value(1)])
        case fo.Always(first=first, last=last, width=width):
            return BOOLEAN.always(value(ahead=(first, last)), width)
        case fo.Eventually(first=first, last=last, width=width):
            return BOOLEAN.eventually(value(ahead=(first, last)), width)
        case fo.Until(first=first, last=last):
            left, right = value(0, ahead=(0, last)), value(1, ahead=(first, last))
            return BOOLEAN.until(left, right, first, last)
        case _:
            message = f"unknown formula {type(formula).__name__}"
            raise TypeError(message)
