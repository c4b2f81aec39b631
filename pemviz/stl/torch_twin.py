"""The same robustness in torch, differentiable with respect to the signals.

For gradients, not for ranking: values agree with `pemviz.stl.robustness` to 1e-9 in
double precision. Where a minimum is attained more than once, its gradient is shared.
"""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import TypeAlias

import torch
from torch import Tensor

from pemviz.errors import InputError
from pemviz.stl.agm import Agm, clipping_flips
from pemviz.stl.bounds import margin_range
from pemviz.stl.checks import check_finite, check_horizon, check_names
from pemviz.stl.classical import Classical
from pemviz.stl.errors import shorten
from pemviz.stl.evaluation import Metric, check_signal, predicates_to_check
from pemviz.stl.expressions import Predicate
from pemviz.stl.formulas import Formula
from pemviz.stl.semantics import Semantics, evaluate, margin
from pemviz.stl.smooth_cumulative import SmoothCumulative
from pemviz.stl.windows import sliding, sliding_idempotent

Pair: TypeAlias = tuple[Tensor, ...]


def robustness(formula: Formula, signals: Mapping[str, Tensor], metric: Metric) -> Tensor:
    """Robustness of every rollout at step 0.

    Args:
        formula: the specification.
        signals: floating-point tensors [N, T] by name, of one shape, type and device.
        metric: which robustness, with its parameters.

    Returns:
        [N], of the signals' type; gradients flow back to the signals.

    Raises:
        FormulaError: the formula uses an unknown signal or looks past the rollouts' end.
        InputError: as for the numpy side.
    """
    return _evaluate(formula, signals, metric, steps=1)[:, 0]


def robustness_trace(formula: Formula, signals: Mapping[str, Tensor], metric: Metric) -> Tensor:
    """Robustness of every rollout at every step where the horizon fits.

    Takes and raises what `robustness` does.

    Returns:
        [N, T - formula.horizon_steps()].
    """
    return _evaluate(formula, signals, metric, steps=None)


def _evaluate(
    formula: Formula, signals: Mapping[str, Tensor], metric: Metric, *, steps: int | None
) -> Tensor:
    check_names(formula, signals)
    names = sorted(formula.signals()) or sorted(signals)[:1]
    if not names:
        raise InputError("no signals given; at least one is needed for the number of rollouts")
    used = {name: signals[name] for name in names}
    first = used[names[0]]
    for name, values in used.items():
        if values.ndim != 2 or values.shape != first.shape or not values.is_floating_point():
            raise InputError(
                f"signal {name!r} is {tuple(values.shape)} of {values.dtype}; all signals must"
                " be real, [N, T] and alike"
            )
    states = first.shape[1]
    check_horizon(formula, states)
    time_first = {name: values.T for name, values in used.items()}
    _check_values(formula, time_first, metric)
    steps = states - formula.horizon_steps() if steps is None else steps
    return evaluate(formula, _semantics(metric), time_first, start=0, steps=steps).T


def _check_values(formula: Formula, signals: Mapping[str, Tensor], metric: Metric) -> None:
    for name in formula.signals():
        check_signal(signals[name].detach().cpu().numpy().T, name, metric, first_rollout=0)
    for predicate in predicates_to_check(formula):
        with torch.no_grad():
            steps = len(next(iter(signals.values())))
            by = margin(predicate, TorchClassical(), signals, start=0, steps=steps)
        check_finite(by.cpu().numpy().T, f"margin of '{shorten(predicate)}'", 0)


def _semantics(metric: Metric) -> Semantics[Tensor]:
    match metric:
        case Classical():
            return TorchClassical()
        case Agm():
            return TorchAgm(metric)
        case SmoothCumulative():
            return TorchSmoothCumulative(metric)


class _TorchSemantics:
    """The part that is the same for all metrics."""

    def minimum(self, left: Tensor | float, right: Tensor | float) -> Tensor:
        return torch.minimum(_tensor(left), _tensor(right))

    def maximum(self, left: Tensor | float, right: Tensor | float) -> Tensor:
        return torch.maximum(_tensor(left), _tensor(right))

    def constant(self, value: float, like: Tensor, steps: int) -> Tensor:
        return like.new_full((steps, like.shape[1]), value)


class TorchClassical(_TorchSemantics):
    """Classical robustness of every operator."""

    def opposite(self) -> TorchClassical:
        return self

    def truth(self, like: Tensor, steps: int) -> Tensor:
        return self.constant(math.inf, like, steps)

    def predicate(self, predicate: Predicate, margin: Tensor) -> Tensor:  # noqa: ARG002
        return margin

    def negate(self, value: Tensor) -> Tensor:
        return -value

    def conjunction(self, values: Sequence[Tensor]) -> Tensor:
        return torch.stack(tuple(values)).amin(0)

    def disjunction(self, values: Sequence[Tensor]) -> Tensor:
        return torch.stack(tuple(values)).amax(0)

    def always(self, value: Tensor, width: int) -> Tensor:
        if len(value) == width:
            return value.amin(0, keepdim=True)
        return sliding_idempotent(_minimum, (value,), width)[0]

    def always_predicate(self, predicate: Predicate, margin: Tensor, width: int) -> Tensor:
        return self.always(self.predicate(predicate, margin), width)

    def eventually(self, value: Tensor, width: int) -> Tensor:
        return -self.always(-value, width)

    def until(self, left: Tensor, right: Tensor, first: int, last: int) -> Tensor:
        later = left[first:]
        pairs = (later, torch.minimum(later, right))
        reached = sliding_idempotent(_then, pairs, last - first + 1)[1]
        if first == 0:
            return reached
        return torch.minimum(self.always(left[: len(reached) + first - 1], first), reached)


class TorchAgm(_TorchSemantics):
    """Agm robustness of every operator."""

    def __init__(self, metric: Agm) -> None:
        self.metric = metric

    def opposite(self) -> TorchAgm:
        return self

    def truth(self, like: Tensor, steps: int) -> Tensor:
        return self.constant(1.0, like, steps)

    def predicate(self, predicate: Predicate, margin: Tensor) -> Tensor:
        low, high = margin_range(predicate, self.metric.bounds)
        if low == high:
            return torch.sign(margin)
        if self.metric.clip:
            clipped = margin.clamp(low, high)
            if bool((clipped.sign() != margin.sign()).any()):
                raise clipping_flips(predicate, low, high)
            margin = clipped
        return margin / (high - low)

    def negate(self, value: Tensor) -> Tensor:
        return -value

    def conjunction(self, values: Sequence[Tensor]) -> Tensor:
        return _conclude(reduce(_join, map(_means, values)), len(values), ties_fail=True)

    def disjunction(self, values: Sequence[Tensor]) -> Tensor:
        means = reduce(_join, [_means(-value) for value in values])
        return -_conclude(means, len(values), ties_fail=False)

    def always(self, value: Tensor, width: int) -> Tensor:
        return _conclude(sliding(_join, _means(value), width), width, ties_fail=True)

    def always_predicate(self, predicate: Predicate, margin: Tensor, width: int) -> Tensor:
        return self.always(self.predicate(predicate, margin), width)

    def eventually(self, value: Tensor, width: int) -> Tensor:
        return -_conclude(sliding(_join, _means(-value), width), width, ties_fail=False)

    def until(self, left: Tensor, right: Tensor, first: int, last: int) -> Tensor:
        steps = len(left) - last
        held = _means(left[:steps])
        missed: list[Pair] = []
        for offset in range(last + 1):
            if offset > 0:
                held = _join(held, _means(left[offset : offset + steps]))
            if offset >= first:
                so_far = _conclude(held, offset + 1, ties_fail=True)
                target = right[offset - first : offset - first + steps]
                missed.append(_means(-self.conjunction([target, so_far])))
        return -_conclude(reduce(_join, missed), len(missed), ties_fail=False)


class TorchSmoothCumulative(_TorchSemantics):
    """One part of the smooth cumulative robustness of every operator."""

    def __init__(self, metric: SmoothCumulative) -> None:
        self.metric = metric
        self.sign = 1.0 if metric.part == "positive" else -1.0

    def opposite(self) -> TorchSmoothCumulative:
        return TorchSmoothCumulative(self.metric.opposite())

    def truth(self, like: Tensor, steps: int) -> Tensor:
        return self.constant(math.inf if self.sign > 0.0 else 0.0, like, steps)

    def predicate(self, predicate: Predicate, margin: Tensor) -> Tensor:  # noqa: ARG002
        scaled = self.sign * self.metric.beta * margin
        return self.sign * torch.logaddexp(scaled, torch.zeros_like(scaled)) / self.metric.beta

    def negate(self, value: Tensor) -> Tensor:
        return -value

    def conjunction(self, values: Sequence[Tensor]) -> Tensor:
        beta = self.metric.beta
        return reduce(_log_add_exp, [-beta * value for value in values]) / -beta

    def disjunction(self, values: Sequence[Tensor]) -> Tensor:
        return -self.conjunction([-value for value in values])

    def always(self, value: Tensor, width: int) -> Tensor:
        total = sliding(_log_add, (-self.metric.beta * value,), width)[0]
        return total / -self.metric.beta

    def always_predicate(self, predicate: Predicate, margin: Tensor, width: int) -> Tensor:
        return self.always(self.predicate(predicate, margin), width)

    def eventually(self, value: Tensor, width: int) -> Tensor:
        return sliding(_add, (value,), width)[0]

    def until(self, left: Tensor, right: Tensor, first: int, last: int) -> Tensor:
        beta, steps = self.metric.beta, len(left) - last
        held = -beta * left[:steps]
        terms: list[Tensor] = []
        for offset in range(last + 1):
            if offset > 0:
                held = _log_add_exp(held, -beta * left[offset : offset + steps])
            if offset >= first:
                target = right[offset - first : offset - first + steps]
                terms.append(_log_add_exp(held, -beta * target) / -beta)
        return torch.stack(terms).sum(0)


def _tensor(value: Tensor | float) -> Tensor:
    # Double keeps every digit; against a signal's tensor a scalar's type does not count.
    return torch.as_tensor(value, dtype=None if isinstance(value, Tensor) else torch.float64)


def _minimum(earlier: Pair, later: Pair) -> Pair:
    return (torch.minimum(earlier[0], later[0]),)


def _then(earlier: Pair, later: Pair) -> Pair:
    held = earlier[0]
    reached = torch.maximum(earlier[1], torch.minimum(held, later[1]))
    return torch.minimum(held, later[0]), reached


def _means(values: Tensor) -> Pair:
    # Unlike in numpy, the logarithm must stay finite everywhere: NaN gradients spread.
    return values, values.clamp(max=0.0), torch.log1p(values.clamp(min=0.0))


def _join(earlier: Pair, later: Pair) -> Pair:
    return torch.minimum(earlier[0], later[0]), earlier[1] + later[1], earlier[2] + later[2]


def _conclude(means: Pair, count: int, *, ties_fail: bool) -> Tensor:
    least, failing, growth = means
    fails = least <= 0.0 if ties_fail else least < 0.0
    return torch.where(fails, failing / count, torch.expm1(growth / count))


def _log_add_exp(left: Tensor, right: Tensor) -> Tensor:
    """log(exp(left) + exp(right)); where that is infinite (`true`), with gradient 0, not NaN."""
    infinite = torch.isinf(torch.maximum(left, right))
    finite = torch.logaddexp(left.masked_fill(infinite, 0.0), right.masked_fill(infinite, 0.0))
    return torch.where(infinite, torch.maximum(left, right).detach(), finite)


def _log_add(earlier: Pair, later: Pair) -> Pair:
    return (_log_add_exp(earlier[0], later[0]),)


def _add(earlier: Pair, later: Pair) -> Pair:
    return (earlier[0] + later[0],)
