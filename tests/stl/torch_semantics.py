"""The operators of the three metrics once more, in torch: stacked, not folded in place."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import TypeAlias

import torch
from torch import Tensor

from pemviz.stl.agm import Agm, clipping_flips
from pemviz.stl.bounds import margin_range
from pemviz.stl.classical import Classical
from pemviz.stl.evaluation import Metric
from pemviz.stl.expressions import Predicate
from pemviz.stl.formulas import Formula
from pemviz.stl.semantics import Semantics, evaluate
from pemviz.stl.smooth_cumulative import SmoothCumulative
from pemviz.stl.windows import sliding, sliding_idempotent

Pair: TypeAlias = tuple[Tensor, ...]


def robustness_trace(formula: Formula, signals: Mapping[str, Tensor], metric: Metric) -> Tensor:
    """What `pemviz.stl.robustness_trace` gives, [N, T - formula.horizon_steps()]."""
    time_first = {name: values.T for name, values in signals.items()}
    steps = len(next(iter(time_first.values()))) - formula.horizon_steps()
    return evaluate(formula, _semantics(metric), time_first, start=0, steps=steps).T


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

    def predicate(self, predicate: Predicate, margin: Tensor) -> Tensor:
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
        return _conclude(reduce(_join, map(_means, values)), len(values))

    def disjunction(self, values: Sequence[Tensor]) -> Tensor:
        means = reduce(_join, [_means(-value) for value in values])
        return -_conclude(means, len(values))

    def always(self, value: Tensor, width: int) -> Tensor:
        return _conclude(sliding(_join, _means(value), width), width)

    def always_predicate(self, predicate: Predicate, margin: Tensor, width: int) -> Tensor:
        return self.always(self.predicate(predicate, margin), width)

    def eventually(self, value: Tensor, width: int) -> Tensor:
        return -_conclude(sliding(_join, _means(-value), width), width)

    def until(self, left: Tensor, right: Tensor, first: int, last: int) -> Tensor:
        steps = len(left) - last
        held = _means(left[:steps])
        missed: list[Pair] = []
        for offset in range(last + 1):
            if offset > 0:
                held = _join(held, _means(left[offset : offset + steps]))
            if offset >= first:
                so_far = _conclude(held, offset + 1)
                target = right[offset - first : offset - first + steps]
                missed.append(_means(-self.conjunction([target, so_far])))
        return -_conclude(reduce(_join, missed), len(missed))


class TorchSmoothCumulative(_TorchSemantics):
    """One part of the smooth cumulative robustness of every operator."""

    def __init__(self, metric: SmoothCumulative) -> None:
        self.metric = metric
        self.sign = 1.0 if metric.part == "positive" else -1.0

    def opposite(self) -> TorchSmoothCumulative:
        return TorchSmoothCumulative(self.metric.opposite())

    def truth(self, like: Tensor, steps: int) -> Tensor:
        return self.constant(math.inf if self.sign > 0.0 else 0.0, like, steps)

    def predicate(self, predicate: Predicate, margin: Tensor) -> Tensor:
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


def _conclude(means: Pair, count: int) -> Tensor:
    least, failing, growth = means
    return torch.where(least <= 0.0, failing / count, torch.expm1(growth / count))


def _log_add_exp(left: Tensor, right: Tensor) -> Tensor:
    """log(exp(left) + exp(right)); where that is infinite (`true`), with gradient 0, not NaN."""
    infinite = torch.isinf(torch.maximum(left, right))
    finite = torch.logaddexp(left.masked_fill(infinite, 0.0), right.masked_fill(infinite, 0.0))
    return torch.where(infinite, torch.maximum(left, right).detach(), finite)


def _log_add(earlier: Pair, later: Pair) -> Pair:
    return (_log_add_exp(earlier[0], later[0]),)


def _add(earlier: Pair, later: Pair) -> Pair:
    return (earlier[0] + later[0],)
