"""Robustness of a formula on a batch of rollouts, and whether its signals are fit for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import InputError
from pemviz.stl.agm import Agm
from pemviz.stl.formulas import (
    Formula,
    FormulaError,
    Node,
    Predicate,
    Product,
    Quotient,
    Truth,
    Until,
    shorten,
)
from pemviz.stl.metric import Metric, evaluate, margin
from pemviz.stl.parsing import unknown_signal

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

    Example:
        >>> import numpy as np
        >>> from pemviz import stl
        >>> gap_m = np.array([[9.0, 4.0, 2.5], [9.0, 3.0, 1.5]])  # two rollouts, three states
        >>> formula = stl.parse("always[0,2] (gap >= 2.0)")
        >>> print(stl.robustness(formula, {"gap": gap_m}, stl.Classical()))
        [ 0.5 -0.5]
    """
    return robustness_trace(formula, signals, metric, steps=1)[:, 0]


def robustness_trace(
    formula: Formula, signals: Mapping[str, AnyArray], metric: Metric, *, steps: int | None = None
) -> FloatArray:
    """Robustness of every rollout at the first ``steps`` steps, or where the horizon fits.

    Takes what `robustness` does.

    Returns:
        [N, steps], or [N, T - formula.horizon_steps()]. Rows do not depend on each other.

    Raises:
        InputError: as `robustness` does.
    """
    used, (rollouts, states) = _select(formula, signals)
    horizon = formula.horizon_steps()
    if horizon >= states:
        raise FormulaError(
            f"formula looks {horizon} steps ahead and needs {horizon + 1} states;"
            f" the rollouts have {states} (steps 0 to {states - 1})"
        )
    steps = states - horizon if steps is None else steps
    needed, named, parts = steps + horizon, formula.signals(), list(formula.walk())
    predicates = _predicates_to_check(parts)
    has_until = any(isinstance(part, Until) for part in parts)
    size = max(BLOCK_VALUES // states, BLOCK_ROLLOUTS_UNTIL if has_until else BLOCK_ROLLOUTS)
    result = np.empty((rollouts, steps))

    for start in range(0, rollouts, size):
        rows = slice(start, start + size)
        for name in named:
            _check_signal(used[name][rows], name, metric, start)
        block = {name: time_first(values[rows, :needed]) for name, values in used.items()}
        with np.errstate(all="ignore"):  # what is not finite is reported, or meant
            for predicate in predicates:
                by = margin(predicate, block, start=0, steps=needed)
                _check_finite(by.T, f"margin of '{shorten(predicate)}'", start)
            result[rows] = evaluate(formula, metric, block, steps=steps).T

    may_be_infinite = any(isinstance(part, Truth) for part in parts)
    if (np.isnan(result) if may_be_infinite else ~np.isfinite(result)).any():
        raise InputError("robustness is beyond the largest number; rescale the signals")
    return result


def time_first(values: AnyArray) -> FloatArray:
    """[n, T] as [T, n] with rollouts side by side in memory; a view where they lie so already."""
    block = np.asarray(values.T, dtype=np.float64)
    return block if block.strides[-1] == block.itemsize else np.ascontiguousarray(block)


def _select(
    formula: Formula, signals: Mapping[str, AnyArray]
) -> tuple[dict[str, AnyArray], tuple[int, int]]:
    """The signals that the formula uses (any one, for the shape, if none), and (N, T)."""
    names = sorted(formula.signals()) or sorted(signals)[:1]
    for name in names:
        if name not in signals:
            raise FormulaError(unknown_signal(name, signals))
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
                " all must be equal"
            )
        if values.dtype.kind not in "fiub":
            raise InputError(f"signal {name!r} has type {values.dtype}; must be real numbers")
    return used, shape


def _predicates_to_check(parts: Sequence[Node]) -> tuple[Predicate, ...]:
    """Predicates among a formula's parts that finite signals may leave infinite or undefined."""
    if not any(isinstance(part, Product | Quotient) for part in parts):
        return ()
    return tuple(
        part
        for part in parts
        if isinstance(part, Predicate)
        and any(isinstance(node, Product | Quotient) for node in part.walk())
    )


def _check_signal(values: AnyArray, name: str, metric: Metric, first_rollout: int) -> None:
    """Name rollout and step where [n, T] do not suit the metric."""
    if not isinstance(metric, Agm) or metric.clip or name not in metric.bounds:
        _check_finite(values, f"signal {name!r}", first_rollout)
        return
    low, high = metric.bounds[name]
    if values.size and not (values.min() >= low and values.max() <= high):
        _check_finite(values, f"signal {name!r}", first_rollout)
        rollout, step = np.argwhere((values < low) | (values > high))[0]
        raise InputError(
            f"agm: signal {name!r} is {values[rollout, step]} at rollout"
            f" {first_rollout + rollout}, step {step}; declared bounds [{low:g}, {high:g}]"
            " (widen them, or choose clipping)"
        )


def _check_finite(values: FloatArray, what: str, first_rollout: int) -> None:
    if not np.isfinite(values).all():
        rollout, step = np.argwhere(~np.isfinite(values))[0]
        raise InputError(
            f"{what} is {values[rollout, step]} at rollout {first_rollout + rollout},"
            f" step {step}; it must be finite"
        )
