"""Robustness of a formula on a batch of rollouts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import InputError
from pemviz.stl.agm import Agm, AgmSemantics
from pemviz.stl.checks import check_bounds, check_finite, check_horizon, check_names
from pemviz.stl.classical import Classical, ClassicalSemantics
from pemviz.stl.errors import shorten
from pemviz.stl.expressions import Predicate, Product, Quotient
from pemviz.stl.formulas import Formula, Truth, negates
from pemviz.stl.semantics import Semantics, evaluate, margin
from pemviz.stl.smooth_cumulative import SmoothCumulative, SmoothCumulativeSemantics
from pemviz.stl.temporal import Until

Metric: TypeAlias = Classical | Agm | SmoothCumulative
Signals: TypeAlias = Mapping[str, FloatArray]

BLOCK_VALUES = 1 << 16
"""Values of one signal evaluated at once: few enough to stay in the cache."""

BLOCK_ROLLOUTS = 8
"""Fewest rollouts evaluated at once."""

BLOCK_ROLLOUTS_UNTIL = 128
"""The same for formulas with an until, which goes step by step."""


def robustness(formula: Formula, signals: Mapping[str, AnyArray], metric: Metric) -> FloatArray:
    """Robustness of every rollout at step 0.

    Args:
        formula: the specification.
        signals: [N, T] by name; all that the formula uses, of one shape.
        metric: which robustness, with its parameters.

    Returns:
        [N]. Finite, except that ``true`` alone is infinite where its metric says so.

    Raises:
        FormulaError: the formula uses an unknown signal or looks past the rollouts' end.
        InputError: a signal has the wrong shape or type, is not finite, or (agm) leaves
            its bounds; the message names rollout and step.
    """
    return _by_blocks(formula, signals, metric, steps=1)[:, 0]


def robustness_trace(
    formula: Formula, signals: Mapping[str, AnyArray], metric: Metric
) -> FloatArray:
    """Robustness of every rollout at every step where the formula's horizon fits.

    Takes and raises what `robustness` does.

    Returns:
        [N, T - formula.horizon_steps()].
    """
    return _by_blocks(formula, signals, metric, steps=None)


@dataclass(frozen=True)
class SubformulaTrace:
    """One part of a formula, and its robustness over time.

    Attributes:
        path: index of the child to take at every level, from the whole formula down.
        formula: the part.
        metric: the metric its values are in (under a negation, smooth-cumulative's
            other part).
        values: [N, T - formula.horizon_steps()].
    """

    path: tuple[int, ...]
    formula: Formula
    metric: Metric
    values: FloatArray


def subformula_traces(
    formula: Formula, signals: Mapping[str, AnyArray], metric: Metric | None = None
) -> tuple[SubformulaTrace, ...]:
    """Robustness over time of the formula and all its parts: which part fails when.

    Args:
        formula: the specification.
        signals: [N, T] by name.
        metric: classical if None.

    Returns:
        One entry per part that is a formula, the whole first, then depth first, left
        to right. Raises what `robustness` does.
    """
    return tuple(
        SubformulaTrace(path, part, used, robustness_trace(part, signals, used))
        for path, part, used in _parts(formula, metric or Classical(), ())
    )


def _parts(
    formula: Formula, metric: Metric, path: tuple[int, ...]
) -> Iterator[tuple[tuple[int, ...], Formula, Metric]]:
    yield path, formula, metric
    opposite = metric.opposite() if isinstance(metric, SmoothCumulative) else metric
    for index, part in enumerate(formula.children()):
        if isinstance(part, Formula):
            used = opposite if negates(formula, index) else metric
            yield from _parts(part, used, (*path, index))


def _semantics(metric: Metric) -> Semantics[FloatArray]:
    match metric:
        case Classical():
            return ClassicalSemantics()
        case Agm():
            return AgmSemantics(metric)
        case SmoothCumulative():
            return SmoothCumulativeSemantics(metric)


def _by_blocks(
    formula: Formula, signals: Mapping[str, AnyArray], metric: Metric, *, steps: int | None
) -> FloatArray:
    """[N, steps], or as many steps as the horizon leaves. Rows do not depend on each other."""
    used, (rollouts, states) = _select(formula, signals)
    check_horizon(formula, states)
    steps = states - formula.horizon_steps() if steps is None else steps
    semantics = _semantics(metric)
    needed, predicates = steps + formula.horizon_steps(), predicates_to_check(formula)
    named = formula.signals()
    result = np.empty((rollouts, steps))
    size = _block_rollouts(formula, states)

    for start in range(0, rollouts, size):
        rows = slice(start, start + size)
        for name in named:
            check_signal(used[name][rows], name, metric, first_rollout=start)
        block = {name: time_first(values[rows, :needed]) for name, values in used.items()}
        with np.errstate(all="ignore"):  # what is not finite is reported, or meant
            _check_margins(predicates, block, start)
            result[rows] = evaluate(formula, semantics, block, start=0, steps=steps).T
    return _all_finite(result, formula)


def _all_finite(robustness: FloatArray, formula: Formula) -> FloatArray:
    may_be_infinite = any(isinstance(part, Truth) for part in formula.walk())
    wrong = np.isnan(robustness) if may_be_infinite else ~np.isfinite(robustness)
    if wrong.any():
        raise InputError("robustness is beyond the largest number; rescale the signals")
    return robustness


def time_first(values: AnyArray) -> FloatArray:
    """[n, T] as [T, n] with rollouts side by side in memory; a view where they lie so already."""
    block = np.asarray(values.T, dtype=np.float64)
    return block if block.strides[-1] == block.itemsize else np.ascontiguousarray(block)


def _block_rollouts(formula: Formula, states: int) -> int:
    has_until = any(isinstance(part, Until) for part in formula.walk())
    return max(BLOCK_VALUES // states, BLOCK_ROLLOUTS_UNTIL if has_until else BLOCK_ROLLOUTS)


def predicates_to_check(formula: Formula) -> tuple[Predicate, ...]:
    """Predicates that finite signals may leave infinite or undefined."""
    return tuple(
        part
        for part in formula.walk()
        if isinstance(part, Predicate)
        and any(isinstance(node, Product | Quotient) for node in part.walk())
    )


def check_signal(values: AnyArray, name: str, metric: Metric, *, first_rollout: int) -> None:
    """Raises InputError that names rollout and step where [n, T] do not suit the metric."""
    if isinstance(metric, Agm) and not metric.clip and name in metric.bounds:
        check_bounds(values, name, metric.bounds[name], first_rollout)
    else:
        check_finite(values, f"signal {name!r}", first_rollout)


def _check_margins(predicates: tuple[Predicate, ...], block: Signals, start: int) -> None:
    steps = len(next(iter(block.values())))
    for predicate in predicates:
        by = margin(predicate, ClassicalSemantics(), block, start=0, steps=steps)
        check_finite(by.T, f"margin of '{shorten(predicate)}'", start)


def _select(
    formula: Formula, signals: Mapping[str, AnyArray]
) -> tuple[dict[str, AnyArray], tuple[int, int]]:
    """The signals that the formula uses (any one, for the shape, if none), and (N, T)."""
    check_names(formula, signals)
    names = sorted(formula.signals()) or sorted(signals)[:1]
    if not names:
        raise InputError("no signals given; at least one is needed for the number of rollouts")
    used = {name: np.asarray(signals[name]) for name in names}
    shape = used[names[0]].shape
    for name, values in used.items():
        if values.ndim != 2:
            raise InputError(f"signal {name!r} has shape {values.shape}; must be [N, T]")
        if values.shape != shape:
            raise InputError(
                f"signal {name!r} has shape {values.shape}, {names[0]!r} has {shape};"
                " all must be alike"
            )
        if values.dtype.kind not in "fiub":
            raise InputError(f"signal {name!r} has type {values.dtype}; must be real numbers")
    return used, shape
