"""Robustness of formulas that join folds, mostly by compiled loops.

A fold asks that a predicate hold always or eventually over an interval of steps. One signal that is
compared with a number is read where it lies: no margins, no transposed blocks. Of what else is
compared, margins are formed first, a block at a time.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import InputError
from pemviz.lanes import LANES
from pemviz.stl.agm import AgmSemantics, compounded, conclude_all
from pemviz.stl.classical import ClassicalSemantics
from pemviz.stl.compiled import DECISION
from pemviz.stl.dominant import LARGEST_EXPONENT, DominantSteps
from pemviz.stl.expressions import (
    Absolute,
    Constant,
    Difference,
    Negative,
    Predicate,
    Product,
    Signal,
    Sum,
)
from pemviz.stl.formulas import And, Formula, Implies, Not, Or
from pemviz.stl.semantics import Semantics, margin
from pemviz.stl.smooth_cumulative import SmoothCumulativeSemantics
from pemviz.stl.tasks import Near, Task, means_of
from pemviz.stl.temporal import Always, Eventually

BLOCK_VALUES = 1 << 19
"""Values of one signal, or margins, that are folded at once."""

COPIED_VALUES = 1 << 18
"""The same where rollouts' values do not lie in one piece, and are copied so."""

EXPONENTS = 1 << 16
"""Exponentials that are taken at once."""

FINITE = (-sys.float_info.max, sys.float_info.max)


class UnservedError(Exception):
    """The loops cannot tell: numpy answers, or tells what is wrong."""


@dataclass(frozen=True)
class Fold:
    """What must hold of one number a step, always or eventually.

    Attributes:
        name: The signal that is compared; ``None`` if it is the predicate's margin.
        offset: The number that it is compared with.
        above: Whether the predicate holds above it.
        formula: The always or eventually.
    """

    name: str | None
    offset: float
    above: bool
    formula: Always | Eventually

    @property
    def always(self) -> bool:
        """Whether it must hold always."""
        return isinstance(self.formula, Always)

    @property
    def predicate(self) -> Predicate:
        """What must hold."""
        assert isinstance(self.formula.operand, Predicate)  # noqa: S101  or it is no fold
        return self.formula.operand

    @property
    def window(self) -> tuple[int, int]:
        """The first step, and the one after the last."""
        return self.formula.first, self.formula.last + 1

    @property
    def sign(self) -> float:
        """Of the distances (value - offset) * sign that a conjunction of all steps folds."""
        return 1.0 if self.above is self.always else -1.0

    def classical(self, least: FloatArray, most: FloatArray) -> FloatArray:
        """Classical robustness, from the extremes of the signal over the steps.

        Rounding keeps order, so that the least margin is that of the least or largest value.
        """
        if self.above:
            return (least if self.always else most) - self.offset
        return self.offset - (most if self.always else least)


def fold_of(formula: Formula) -> Fold | None:
    """``formula`` as a fold, if it is one."""
    if not isinstance(formula, Always | Eventually):
        return None
    match formula.operand:
        case Predicate(left=Signal(name=name), right=Constant(value=offset)) as predicate:
            return Fold(name, offset, predicate.is_lower_bound, formula)
        case Predicate(left=Constant(value=offset), right=Signal(name=name)) as predicate:
            return Fold(name, offset, not predicate.is_lower_bound, formula)
        case Predicate() as predicate if predicate.signals() and _shows_all(predicate):
            return Fold(None, 0.0, True, formula)
        case _:
            return None


def _shows_all(predicate: Predicate) -> bool:
    """Whether the margin cannot be finite unless all signals are."""
    shown = Predicate, Signal, Constant, Sum, Difference, Product, Negative, Absolute
    return all(isinstance(part, shown) for part in predicate.walk())


def leaves(formula: Formula) -> Iterator[Formula]:
    """The parts that and, or, not and implies join."""
    if isinstance(formula, And | Or | Implies | Not):
        for part in formula.children():
            assert isinstance(part, Formula)  # noqa: S101  they join formulas alone
            yield from leaves(part)
    else:
        yield formula


def is_served(
    formula: Formula, semantics: Semantics[FloatArray], signals: Mapping[str, AnyArray]
) -> bool:
    """Whether the loops know all of ``formula``, at step 0, under this metric."""
    if any(values.dtype != np.float64 or not values.size for values in signals.values()):
        return False
    folds = [fold_of(leaf) for leaf in leaves(formula)]
    match semantics:
        case ClassicalSemantics():
            return all(folds)
        case AgmSemantics(metric=metric):
            known = not metric.clip and all(name in metric.bounds for name in signals)
            return known and all(folds)
        case SmoothCumulativeSemantics():
            return all(fold and isinstance(fold.formula, Always) for fold in folds)
        case _:
            return False


class FoldedRobustness:
    """Robustness ``[1, N]`` at step 0 of a formula that `is_served`."""

    def __init__(self, loops: Any, signals: Mapping[str, AnyArray]) -> None:
        self._loops, self._signals = loops, signals
        self._within: set[str] = set()  # signals that were seen to lie within bounds

    def __call__(self, formula: Formula, semantics: Semantics[FloatArray]) -> FloatArray:
        """The values.

        Raises:
            UnservedError: A signal is not fit to be asked.
            InputError: The metric's bounds give a predicate no range.
        """
        match formula:
            case Not(operand=operand):
                return semantics.negate(self(operand, semantics.opposite()))
            case And(parts=parts):
                return semantics.conjunction([self(part, semantics) for part in parts])
            case Or(parts=parts):
                return semantics.disjunction([self(part, semantics) for part in parts])
            case Implies(premise=premise, conclusion=conclusion):
                negated = semantics.negate(self(premise, semantics.opposite()))
                return semantics.disjunction([negated, self(conclusion, semantics)])
            case _:
                return self._folded(formula, semantics)

    def _folded(self, formula: Formula, semantics: Semantics[FloatArray]) -> FloatArray:
        fold = fold_of(formula)
        assert fold is not None  # noqa: S101  it is served
        if fold.name is not None:
            return self._of_values(self._signals[fold.name], fold, semantics)
        named = {name: self._signals[name] for name in fold.predicate.signals()}
        if isinstance(semantics, AgmSemantics):
            for name, values in named.items():
                self._check_bounds(name, values, semantics)
        rollouts, states = next(iter(named.values())).shape
        result, size = np.empty((1, rollouts)), max(1, BLOCK_VALUES // states)
        for start in range(0, rollouts, size):
            block = {name: values[start : start + size].T for name, values in named.items()}
            by = margin(fold.predicate, ClassicalSemantics(), block, start=0, steps=states)
            result[:, start : start + size] = self._of_values(by.T, fold, semantics)
        return result

    def _check_bounds(self, name: str, values: FloatArray, semantics: AgmSemantics) -> None:
        """That all of a signal lies within them, in whatever order they are looked at."""
        if name in self._within:
            return
        lines = values if values.flags.c_contiguous else values.T
        least, most = np.empty((2, len(lines)))
        bounds = semantics.metric.bounds[name]
        task = Task(np.ascontiguousarray(lines), 0, lines.shape[1], 0.0, 1.0, *bounds)
        if not self._loops.all_extremes(task, least, most):
            raise UnservedError
        self._within.add(name)

    def _of_values(
        self, values: FloatArray, fold: Fold, semantics: Semantics[FloatArray]
    ) -> FloatArray:
        """Of numbers ``[n, T]``, which are compared with the fold's."""
        if self._loops is None or needs_no_loops(semantics, {"": values}):
            return _classical_by_step(values.T, fold)
        result = np.empty((1, len(values)))
        in_rows = values.flags.c_contiguous
        size = max(1, (BLOCK_VALUES if in_rows else COPIED_VALUES) // values.shape[1])
        for start in range(0, len(values), size):
            block = self._rows(values, start, min(start + size, len(values)))
            result[0, start : start + size] = self._of_block(block, fold, semantics)
        return result

    def _rows(self, values: FloatArray, start: int, stop: int) -> FloatArray:
        """The rollouts from ``start`` to before ``stop``, each in one piece."""
        shape = stop - start, values.shape[1]
        if min(shape) < LANES or values.flags.c_contiguous or not values.flags.f_contiguous:
            return np.ascontiguousarray(values[start:stop])
        rows = np.empty(shape)
        self._loops.turned(values.T, start, rows)
        return rows

    def _of_block(
        self, block: FloatArray, fold: Fold, semantics: Semantics[FloatArray]
    ) -> FloatArray:
        match semantics:
            case AgmSemantics():
                return self._agm(block, fold, semantics)
            case SmoothCumulativeSemantics():
                return self._smooth(block, fold, semantics)
            case _:
                return self._classical(block, fold)

    def _classical(self, block: FloatArray, fold: Fold) -> FloatArray:
        task = Task(block, *fold.window, fold.offset, fold.sign, *FINITE)
        least, most = np.empty((2, len(block)))
        if not self._loops.all_extremes(task, least, most):
            raise UnservedError
        return fold.classical(least, most)

    def _agm(self, block: FloatArray, fold: Fold, semantics: AgmSemantics) -> FloatArray:
        scale = semantics.scale(fold.predicate)
        if scale is None:
            raise UnservedError
        bounds = FINITE if fold.name is None else semantics.metric.bounds[fold.name]
        task = Task(block, *fold.window, fold.offset, fold.sign * scale, *bounds)
        count, width = len(block), fold.formula.width
        means = means_of(count, width, compounded(width))
        if not self._loops.mean_parts(task, means):
            raise UnservedError
        value = conclude_all(means.fails, means.failing, means.growth, width)
        return value if fold.always else -value

    def _smooth(
        self, block: FloatArray, fold: Fold, semantics: SmoothCumulativeSemantics
    ) -> FloatArray:
        count, width = len(block), fold.formula.width
        steps = DominantSteps(semantics.metric.beta, semantics.sign > 0.0, width)
        task = Task(block, *fold.window, fold.offset, fold.sign, *FINITE)
        near = Near(
            steps.beta, steps.positive, steps.reach, LARGEST_EXPONENT, np.empty(count),
            np.empty(count + 1, dtype=np.int64), np.empty(max(EXPONENTS, width + 8)),
        )  # fmt: skip
        total, done = np.zeros(count), 0
        while done < count:
            end, allowed = self._loops.exponents_near(task, near, done)
            if not allowed:
                raise UnservedError
            powers = near.exponents[: near.ends[end]]
            np.exp(powers, out=powers)
            shift = steps.shift(near.base[done:end])
            self._loops.add_powers(near.ends[done:], powers, shift, total[done:end], steps.positive)
            done = end
        return steps.result(near.base, total)


def needs_no_loops(semantics: Semantics[FloatArray], signals: Mapping[str, AnyArray]) -> bool:
    """Whether numpy's minimum and maximum over steps are as good.

    They are for the classical metric where rollouts lie side by side in memory.
    """
    is_classical = isinstance(semantics, ClassicalSemantics)
    return is_classical and all(values.T.flags.c_contiguous for values in signals.values())


def _classical_by_step(values: FloatArray, fold: Fold) -> FloatArray:
    """Classical robustness ``[1, N]`` from ``values [T, N]``, all finite, by numpy alone."""
    steps, rollouts = values.shape
    result, size = np.empty((1, rollouts)), max(1, COPIED_VALUES // steps)
    before, after = (slice(0, fold.window[0]), slice(fold.window[1], steps))
    for start in range(0, rollouts, size):
        block = values[:, start : start + size]
        within = block[slice(*fold.window)]
        least, most = within.min(axis=0), within.max(axis=0)
        ends = [least, most, *(part for part in (block[before], block[after]) if part.size)]
        if not all(np.isfinite(end).all() for end in ends):
            raise UnservedError
        result[0, start : start + size] = fold.classical(least, most)
    return result


def folded_robustness(
    formula: Formula, signals: Mapping[str, AnyArray], semantics: Semantics[FloatArray]
) -> FloatArray | None:
    """Robustness ``[1, N]`` at step 0 by compiled loops.

    ``None`` where they do not know the formula, are not there, or are not worth their loading; or
    where something is wrong, which numpy then tells.

    Args:
        formula: Whose horizon fits.
        signals: ``[N, T]`` by name, those that the formula uses.
        semantics: The metric's.
    """
    if not is_served(formula, semantics, signals):
        return None
    loops = None
    if not needs_no_loops(semantics, signals):
        loops = DECISION.loops_for(sum(values.size for values in signals.values()))
        if loops is None:
            return None
    try:
        return FoldedRobustness(loops, signals)(formula, semantics)
    except (UnservedError, InputError):
        return None
