"""Whether a formula holds: its Boolean semantics, strict comparisons as they are written.

Classical robustness tells wherever it is not 0: above 0 the formula holds, below it fails (Donze &
Maler, FORMATS 2010, theorem 1; a difference of two doubles is 0 only if they are equal). At 0 some
comparison has equal sides, and whether it is strict decides.
"""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.stl.classical import Classical, ClassicalSemantics
from pemviz.stl.evaluation import robustness, time_first
from pemviz.stl.expressions import Predicate
from pemviz.stl.formulas import Formula, negates
from pemviz.stl.semantics import evaluate


class BooleanSemantics(ClassicalSemantics):
    """1 where a part holds and -1 where it fails, by classical robustness' own operators."""

    def truth(self, like: FloatArray, steps: int) -> FloatArray:
        return self.constant(1.0, like, steps)

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:
        holds = margin > 0.0 if predicate.is_strict else margin >= 0.0
        return np.where(holds, 1.0, -1.0)


def violated(formula: Formula, signals: Mapping[str, AnyArray]) -> BoolArray:
    """Which rollouts violate the formula at step 0: the only thing that counts violations.

    Whatever metric ranks the rollouts, it is the formula's Boolean semantics that decides: at a
    margin of exactly 0 ``>=`` and ``<=`` hold, ``>`` and ``<`` fail. Takes and raises what
    :func:`pemviz.stl.robustness` does.

    Returns:
        ``[N]`` bool.
    """
    classical = robustness(formula, signals, Classical())
    fails = classical < 0.0
    if ties_hold(formula):
        return fails
    tied = np.flatnonzero(classical == 0.0)
    if tied.size:
        some = {n: time_first(np.asarray(signals[n])[tied]) for n in formula.signals() or signals}
        with np.errstate(all="ignore"):  # what is not finite was reported above
            value = evaluate(formula, BooleanSemantics(), some, start=0, steps=1)
        fails[tied] = value[0] < 0.0
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
        return
    for index, part in enumerate(formula.children()):
        if isinstance(part, Formula):
            yield from _ties(part, negated=negated != negates(formula, index))
