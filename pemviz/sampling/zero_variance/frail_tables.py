"""From the values of the reachable states, one for each visibility u, to the proposal."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from scipy.special import logsumexp

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.proposals.zero_variance import ZeroVarianceProposal, cell_keys
from pemviz.sampling.state.composed import without_following
from pemviz.sampling.zero_variance.frail import FrailModel, by_visibility
from pemviz.sampling.zero_variance.frail_proposal import (
    FrailZeroVarianceProposal,
    KnownValues,
    between_nodes,
    value_nodes,
)
from pemviz.sampling.zero_variance.left_out import left_out_share
from pemviz.sampling.zero_variance.merging import (
    LARGEST_LAYER,
    MERGE_DISTANCE,
    Pause,
    no_pause,
    state_columns,
)
from pemviz.sampling.zero_variance.reachable_states import (
    SAFE_NODE,
    UNSAFE_NODE,
    StateGraph,
    Unsafe,
    explore,
)
from pemviz.sampling.zero_variance.tables import counting, tabulated
from pemviz.sampling.zero_variance.values import Values, log_values, solve
from pemviz.types import Simulator, StateBatch, outcome_log_likelihood

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
