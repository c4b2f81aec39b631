"""The value function and its proposal where obstacles differ: one for each visibility u.

Given u, outcomes depend on the state alone, so that V(s | u) is the value function of
:mod:`pemviz.sampling.zero_variance.values` for an error model like any other, on one and the same
graph of states. Outcomes so far tell of u alone: the value of a state with a history is

    V(s, history) = sum_j P(u_j | history) V(s | u_j)

with the nodes u_j of :mod:`pemviz.pem.models.memory`, and the proposal that conditions on
violation, with s' the state after an outcome::

    q(o | s, history) = P(o | s, history) V(s', history and o) / V(s, history)

Values are kept for fewer nodes than the posterior has; between them their logarithm, which is
smooth in u, is interpolated by a cubic spline. What that costs is variance, not truth.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from scipy.special import log_expit, logsumexp

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.chunks import distinct_rows
from pemviz.pem import Pem
from pemviz.pem.models.memory import VisibilityNodes, log_sums
from pemviz.proposals.offset_logistic import defended
from pemviz.proposals.zero_variance import ZeroVarianceProposal, cell_keys
from pemviz.sampling.state.composed import (
    ComposedPem,
    hidden_in,
    own_pem,
    property_in,
    without_following,
)
from pemviz.sampling.state.last_outcome import last_outcome
from pemviz.sampling.state.visibility import NEXT, GivenVisibility, Visibility
from pemviz.sampling.zero_variance.left_out import left_out_share
from pemviz.sampling.zero_variance.proposal import counting, tabulated
from pemviz.sampling.zero_variance.reachable_states import (
    LARGEST_LAYER,
    MERGE_DISTANCE,
    SAFE_NODE,
    UNSAFE_NODE,
    Layer,
    Pause,
    StateGraph,
    Unsafe,
    explore,
    no_pause,
    state_columns,
)
from pemviz.sampling.zero_variance.values import Values, log_value_at_start, log_values, solve
from pemviz.types import Simulator, StateBatch, outcome_log_likelihood


@dataclass(frozen=True, eq=False)
class FrailModel:
    """An error model of obstacles that differ, taken apart: given u it is one like any other.

    On the system without the visibility
    (:func:`~pemviz.sampling.state.composed.without_following`).

    Attributes:
        single: The model of single outcomes, with the properties beside the visibility.
        visibility: How obstacles differ.
    """

    single: ComposedPem
    visibility: Visibility

    @staticmethod
    def of(pem: Pem) -> "FrailModel | None":
        """The parts of an error model; ``None`` where obstacles are all alike."""
        properties = hidden_in(pem)
        visibility = property_in(properties, Visibility)
        if visibility is None:
            return None
        others = tuple(one for one in properties if one is not visibility)
        return FrailModel(ComposedPem(own_pem(pem), others), visibility)

    @property
    def nodes(self) -> VisibilityNodes:
        """Of the integral over u."""
        return self.visibility.nodes

    def given(self, u: float) -> ComposedPem:
        """The model of obstacles of a visibility."""
        known = GivenVisibility(self.visibility.memory.frailty, u)
        return ComposedPem(self.single.pem, (known, *self.single.properties))

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit ``[...]`` of the model of single outcomes; what came before is left out."""
        return self.single.pem.logit(self.single.own_salient(salient))


def frail_log_probability(
    graph: StateGraph, model: FrailModel, *, pause: Pause = no_pause
) -> float:
    """Log of the failure probability, u integrated out; -inf where it is 0.

    Args:
        graph: Explored with the model.
        model: The error model.
        pause: Called now and then; may raise to stop.
    """
    given = by_visibility(graph, model)
    log_given = [log_value_at_start(given(float(u)), pause=pause) for u in model.nodes.u]
    return float(np.asarray(logsumexp(np.array(log_given) + model.nodes.log_weight)))


def by_visibility(graph: StateGraph, model: FrailModel) -> Callable[[float], StateGraph]:
    """The graph with the logits of 'detected' of an obstacle of a visibility u.

    States whose outcomes are alike are many, and looked for once.
    """
    alike = [_Alike.of(layer) for layer in graph.layers]

    def given(u: float) -> StateGraph:
        layers = (
            replace(layer, pem_logit=same.logit(model, u))
            for layer, same in zip(graph.layers, alike, strict=True)
        )
        return replace(graph, layers=tuple(layers))

    return given


@dataclass(frozen=True, eq=False)
class _Alike:
    """What decides the outcomes of n states: M different things.

    Attributes:
        own: Logits of the model of single outcomes, ``[M]``.
        last: The outcomes before, ``[M]``.
        which: Of each state, ``[n]``; ``None``: all are different.
    """

    own: FloatArray
    last: FloatArray
    which: IntArray | None

    @staticmethod
    def of(layer: Layer) -> "_Alike":
        """Of a layer's states."""
        own = layer.pem_logit
        last = last_outcome(layer.states.signals, otherwise=own)
        found = distinct_rows(np.column_stack([own, last]))
        if found is None:
            return _Alike(own, last, None)
        first, which = found
        return _Alike(own[first], last[first], which)

    def logit(self, model: FrailModel, u: float) -> FloatArray:
        """Of 'detected' given the obstacle's visibility, ``[n]``."""
        logit = model.given(u).after(self.own, self.last[:, None])
        return logit if self.which is None else logit[self.which]


LOWEST, HIGHEST = -2.5, 8.5
"""Of the nodes that values are kept for; beyond, their logarithm goes on as a straight line."""
WIDEST, MOST = 1.0, 32
"""Largest distance of these nodes, and how many there are at most."""


@dataclass(frozen=True, eq=False)
class KnownValues:
    """What is known of one step's states, in the order of their keys.

    Attributes:
        keys: Sorted hashes of the states, ``[n]``.
        after_miss: Index ``[n]`` in the next step's, or SAFE_NODE or UNSAFE_NODE.
        after_hit: The same after a detection.
        log_value: Log V(s | u_k) at the nodes that values are kept for, ``[n, K]``.
    """

    keys: IntArray
    after_miss: IntArray
    after_hit: IntArray
    log_value: AnyArray


@dataclass(frozen=True, kw_only=True, eq=False)
class FrailZeroVarianceProposal(ZeroVarianceProposal):
    """Where it does not know a state's values, or outcomes so far, it is what it is derived from.

    Attributes:
        known: By step.
        between: From values at the nodes kept to those at the posterior's nodes, ``[K, J]``.
    """

    known: tuple[KnownValues, ...]
    between: FloatArray

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]``."""
        result = super().logit(states, pem_logit)
        if NEXT not in states.memory or int(states.step) >= len(self.known):
            return result
        step = int(states.step)
        columns = {**states.signals, **states.memory}
        keys = cell_keys([columns[name] for name in self.names], [self.distance] * len(self.names))
        known = self.known[step]
        place = np.searchsorted(known.keys, keys)
        place[place == known.keys.size] = 0
        found = known.keys[place] == keys
        found &= ~np.asarray(columns.get(self.violated, False), dtype=np.bool_)
        rows = np.flatnonzero(found)
        under_pem = pem_logit[rows]
        after = states.memory[NEXT][rows]
        miss = self._log_value(step + 1, known.after_miss[place[rows]], after["missed"])
        hit = self._log_value(step + 1, known.after_hit[place[rows]], after["detected"])
        possible = np.isfinite(miss) | np.isfinite(hit)
        with np.errstate(invalid="ignore"):  # neither outcome leads to a violation
            optimal = hit + log_expit(under_pem) - miss - log_expit(-under_pem)
        optimal = np.where(possible, optimal, 0.0)
        result[rows] = np.where(
            possible, defended(optimal, under_pem, share=self.defensive), under_pem
        )
        return result

    def _log_value(self, step: int, node: IntArray, log_posterior: FloatArray) -> FloatArray:
        """Log V ``[m]`` of states of a step with posteriors ``[m, J]``."""
        result = np.where(node == UNSAFE_NODE, 0.0, -np.inf)
        live = np.flatnonzero(node >= 0)
        if live.size:
            kept = self.known[step].log_value[node[live]].astype(np.float64)
            # einsum, unlike a library's matrix product, gives a row the same in any batch
            log_value = np.minimum(np.einsum("nk,kj->nj", kept, self.between), 0.0)
            result[live] = log_sums(log_posterior[live] + log_value)
        return result


def value_nodes(frailty: float) -> FloatArray:
    """The u_k ``[K]`` that values are kept for: their logarithm changes within 1 / frailty."""
    distance = min(WIDEST, 1.0 / frailty)
    count = min(1 + round((HIGHEST - LOWEST) / distance), MOST)
    return np.linspace(LOWEST, HIGHEST, count)


def between_nodes(kept: FloatArray, nodes: VisibilityNodes) -> FloatArray:
    """Weights ``[K, J]`` that interpolate values at ``kept [K]`` to ``nodes``; linear beyond."""
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415  slow to import

    spline = make_interp_spline(kept, np.eye(kept.size), k=3)
    u, slope = np.clip(nodes.u, kept[0], kept[-1]), spline.derivative()
    return np.asarray(spline(u) + slope(u) * (nodes.u - u)[:, None], dtype=np.float64).T


ByVisibility = Callable[[float], StateGraph]
"""The graph given a visibility."""
LARGEST_LOG = 1e6
POOLED_OF = 3
"""One of so many nodes is pooled: that decides what is kept, and what unknown states get."""
QUANTILES = (0.1, 0.5, 0.9)
"""Of u given a violation, at which it is tried what an approximate value function leaves out."""


def build_frail_proposal(
    *,
    twin: Simulator,
    model: FrailModel,
    unsafe: Unsafe,
    largest_layer: int = LARGEST_LAYER,
    pause: Pause = no_pause,
) -> ZeroVarianceProposal:
    """Explore the twin, solve for the probability of violation given u, tabulate the proposal.

    Args:
        twin: A scenario whose ``step`` is cheap for many states.
        model: The error model.
        unsafe: What violates the specification.
        largest_layer: Above so many states a step, neighbours are taken for one.
        pause: Called every few tenths of a second; may raise to stop.
    """
    scenario = without_following(twin)
    graph = explore(
        twin=scenario,
        pem=model,
        unsafe=unsafe,
        largest_layer=largest_layer,
        pause=pause,
    )
    given_visibility = by_visibility(graph, model)
    solved = _solved(graph, model, given_visibility, pause)
    left_out = 0.0
    if not graph.exact:
        tried = partial(left_out_share, twin=scenario, unsafe=unsafe, pause=pause)
        left_out = max(
            tried(given, solve(given, pause=pause), pem=model.given(u))
            for u, given in _typical(solved, model, given_visibility)
        )
    plain = tabulated(graph, solved.pooled, twin=scenario, left_out=left_out, pause=pause)
    return FrailZeroVarianceProposal(
        **{part.name: getattr(plain, part.name) for part in fields(plain)},
        known=_known(graph, solved),
        between=solved.between,
    )


@dataclass(frozen=True, eq=False)
class _Solved:
    """Values at the K nodes kept, by layer ``[n, K]``, and pooled over u."""

    log_given: FloatArray
    """Log of the failure probability at the posterior's nodes, ``[J]``."""
    between: FloatArray
    log_value: tuple[AnyArray, ...]
    pooled: Values


def _solved(
    graph: StateGraph, model: FrailModel, given_visibility: ByVisibility, pause: Pause
) -> _Solved:
    """Backward at every node; forward too at those that are pooled."""
    u = value_nodes(model.visibility.memory.frailty)
    log_value = tuple(np.empty((layer.count, u.size), dtype=np.float32) for layer in graph.layers)
    log_start = np.full(u.size, 0.0 if np.all(graph.start == UNSAFE_NODE) else -LARGEST_LOG)
    pool = _Pool.of([layer.count for layer in graph.layers])
    for k in range(u.size):
        given = given_visibility(float(u[k]))
        if k % POOLED_OF == 1:
            values = solve(given, pause=pause)
            pool.add(values, log_weight=-0.5 * float(u[k]) ** 2)
            found = values.log_value
        else:
            found = log_values(given, pause=pause)
        for index, value in enumerate(found):
            log_value[index][:, k] = value
            log_start[k] = found[0][0]
    between = between_nodes(u, model.nodes)
    log_given = np.minimum(log_start @ between, 0.0)
    log_probability = float(np.asarray(logsumexp(log_given + model.nodes.log_weight)))
    return _Solved(log_given, between, log_value, pool.values(log_probability))


@dataclass(frozen=True, eq=False)
class _Pool:
    """What leads by way of each state, over visibilities, by layer ``[n]``."""

    reached: tuple[FloatArray, ...]
    miss: tuple[FloatArray, ...]
    hit: tuple[FloatArray, ...]

    @staticmethod
    def of(counts: list[int]) -> "_Pool":
        """Nothing so far."""
        return _Pool(*(tuple(np.full(count, -np.inf) for count in counts) for _ in range(3)))

    def add(self, values: Values, *, log_weight: float) -> None:
        """One more visibility."""
        for index, value in enumerate(values.log_value):
            through = values.log_reached[index] + log_weight
            np.logaddexp(self.reached[index], through, out=self.reached[index])
            for pooled, is_hit in ((self.miss, False), (self.hit, True)):
                outcome = np.full(value.size, is_hit)
                log_p = outcome_log_likelihood(values.proposal_logit[index], outcome)
                np.logaddexp(pooled[index], through + value + log_p, out=pooled[index])

    def values(self, log_probability: float) -> Values:
        """As if the obstacle's visibility were drawn anew at every state."""
        return Values(
            log_value=tuple(
                np.logaddexp(miss, hit) - reached
                for miss, hit, reached in zip(self.miss, self.hit, self.reached, strict=True)
            ),
            log_reached=self.reached,
            proposal_logit=tuple(h - m for h, m in zip(self.hit, self.miss, strict=True)),
            log_probability=log_probability,
        )


def _known(graph: StateGraph, solved: _Solved) -> tuple[KnownValues, ...]:
    """What the proposal looks up, of states that more than a negligible share leads by."""
    chosen = [counting(solved.pooled, index) for index in range(len(graph.layers))]
    keys = [_keys(layer.states, counts) for layer, counts in zip(graph.layers, chosen, strict=True)]
    orders = [np.argsort(each) for each in keys]
    places = [_places(counts, order) for counts, order in zip(chosen, orders, strict=True)]
    places.append(np.empty(0, dtype=np.int64))
    return tuple(
        KnownValues(
            keys=keys[index][order],
            after_miss=_moved(layer.after_miss[counts][order], places[index + 1]),
            after_hit=_moved(layer.after_hit[counts][order], places[index + 1]),
            log_value=solved.log_value[index][counts][order],
        )
        for index, (layer, counts, order) in enumerate(
            zip(graph.layers, chosen, orders, strict=True)
        )
    )


def _keys(states: StateBatch, counts: BoolArray) -> IntArray:
    columns = [column[counts] for column in state_columns(states)]
    return cell_keys(columns, [MERGE_DISTANCE] * len(columns))


def _places(counts: BoolArray, order: IntArray) -> IntArray:
    """Where each state of a layer stands among the known ones; SAFE_NODE where it does not."""
    place = np.full(counts.size, SAFE_NODE, dtype=np.int64)
    place[np.flatnonzero(counts)[order]] = np.arange(order.size)
    return place


def _moved(node: IntArray, places: IntArray) -> IntArray:
    result = node.astype(np.int64)
    live = result >= 0
    result[live] = places[result[live]]
    return result


def _typical(
    solved: _Solved, model: FrailModel, given_visibility: ByVisibility
) -> Iterator[tuple[float, StateGraph]]:
    """Quantiles of u given a violation, and the graph given each."""
    log_share = solved.log_given + model.nodes.log_weight
    share = np.cumsum(np.exp(log_share - log_share.max()))
    for u in model.nodes.u[np.searchsorted(share / share[-1], QUANTILES)].tolist():
        yield u, given_visibility(u)
