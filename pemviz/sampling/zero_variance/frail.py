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

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import log_expit, logsumexp

from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.chunks import distinct_rows
from pemviz.pem import Pem
from pemviz.pem.models.memory import VisibilityNodes, log_sums
from pemviz.proposals.defensive import defended
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
    Pause,
    StateGraph,
    Unsafe,
    explore,
    no_pause,
    state_columns,
)
from pemviz.sampling.zero_variance.values import Values, log_value_at_start, log_values, solve
from pemviz.types import Simulator, StateBatch, outcome_log_likelihood

LOWEST, HIGHEST = -2.5, 8.5
"""Of the nodes that values are kept for; beyond, their logarithm goes on as a straight line."""
WIDEST, MOST = 1.0, 32
"""Largest distance of these nodes, and how many there are at most."""
LARGEST_LOG = 1e6
POOLED_OF = 3
"""One of so many nodes is pooled: that decides what is kept, and what unknown states get."""
QUANTILES = (0.1, 0.5, 0.9)
"""Of u given a violation, at which it is tried what an approximate value function leaves out."""

ByVisibility = Callable[[float], StateGraph]
"""The graph given a visibility."""


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
        """The parts of an error model; ``None`` where all obstacles are equal."""
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

    The graph was explored with the model; ``pause`` is called now and then.
    """
    given = by_visibility(graph, model)
    log_given = [log_value_at_start(given(float(u)), pause=pause) for u in model.nodes.u]
    return float(np.asarray(logsumexp(np.array(log_given) + model.nodes.log_weight)))


def by_visibility(graph: StateGraph, model: FrailModel) -> ByVisibility:
    """The graph with the logits of 'detected' of an obstacle of a visibility u.

    What decides the outcomes of states, the model's own logit and the outcome before, is the same
    for many of them, and evaluated once.
    """
    decisive: list[tuple[FloatArray, FloatArray, IntArray | slice]] = []
    for layer in graph.layers:
        own = layer.pem_logit
        last = last_outcome(layer.states.signals, otherwise=own)
        found = distinct_rows(np.column_stack([own, last]))
        first, which = (slice(None), slice(None)) if found is None else found
        decisive.append((own[first], last[first][:, None], which))

    def given(u: float) -> StateGraph:
        pem = model.given(u)
        layers = (
            replace(layer, pem_logit=pem.after(own, last)[which])
            for layer, (own, last, which) in zip(graph.layers, decisive, strict=True)
        )
        return replace(graph, layers=tuple(layers))

    return given


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


def build_frail_proposal(
    *,
    twin: Simulator,
    model: FrailModel,
    unsafe: Unsafe,
    largest_layer: int = LARGEST_LAYER,
    pause: Pause = no_pause,
) -> ZeroVarianceProposal:
    """As :func:`~pemviz.sampling.zero_variance.proposal.build_zero_variance_proposal`, given u."""
    twin = without_following(twin)
    graph = explore(twin=twin, pem=model, unsafe=unsafe, largest_layer=largest_layer, pause=pause)
    given_visibility = by_visibility(graph, model)
    solved = _solved(graph, model, given_visibility, pause)
    left_out = 0.0
    if not graph.exact:
        # tried at quantiles of u given a violation
        log_share = solved.log_given + model.nodes.log_weight
        share = np.cumsum(np.exp(log_share - log_share.max()))
        for u in model.nodes.u[np.searchsorted(share / share[-1], QUANTILES)].tolist():
            given, pem = given_visibility(u), model.given(u)
            values = solve(given, pause=pause)
            of_u = left_out_share(given, values, twin=twin, pem=pem, unsafe=unsafe, pause=pause)
            left_out = max(left_out, of_u)
    plain = tabulated(graph, solved.pooled, twin=twin, left_out=left_out, pause=pause)
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
    """As if the obstacle's visibility were sampled anew at every state."""


def _solved(
    graph: StateGraph, model: FrailModel, given_visibility: ByVisibility, pause: Pause
) -> _Solved:
    """Backward at every node; forward too at those that are pooled."""
    nodes = _value_nodes(model.visibility.memory.frailty)
    counts = [layer.count for layer in graph.layers]
    log_value = tuple(np.empty((count, nodes.size), dtype=np.float32) for count in counts)
    log_start = np.full(nodes.size, 0.0 if np.all(graph.start == UNSAFE_NODE) else -LARGEST_LOG)
    # what leads by way of each state, and on after a miss and a hit, over visibilities
    reached, miss, hit = ([np.full(count, -np.inf) for count in counts] for _ in range(3))
    for k, u in enumerate(nodes.tolist()):
        given = given_visibility(u)
        if k % POOLED_OF == 1:
            values = solve(given, pause=pause)
            found = values.log_value
            for index, value in enumerate(found):
                through = values.log_reached[index] - 0.5 * u**2
                np.logaddexp(reached[index], through, out=reached[index])
                for pooled, is_hit in ((miss[index], False), (hit[index], True)):
                    outcome = np.full(value.size, is_hit)
                    log_p = outcome_log_likelihood(values.proposal_logit[index], outcome)
                    np.logaddexp(pooled, through + value + log_p, out=pooled)
        else:
            found = log_values(given, pause=pause)
        for index, value in enumerate(found):
            log_value[index][:, k] = value
            log_start[k] = found[0][0]
    between = _between_nodes(nodes, model.nodes)
    log_given = np.minimum(log_start @ between, 0.0)
    pooled = Values(
        log_value=tuple(
            np.logaddexp(m, h) - through for m, h, through in zip(miss, hit, reached, strict=True)
        ),
        log_reached=tuple(reached),
        proposal_logit=tuple(h - m for h, m in zip(hit, miss, strict=True)),
        log_probability=float(np.asarray(logsumexp(log_given + model.nodes.log_weight))),
    )
    return _Solved(log_given, between, log_value, pooled)


def _value_nodes(frailty: float) -> FloatArray:
    """The u_k ``[K]`` that values are kept for: their logarithm changes within 1 / frailty."""
    distance = min(WIDEST, 1.0 / frailty)
    count = min(1 + round((HIGHEST - LOWEST) / distance), MOST)
    return np.linspace(LOWEST, HIGHEST, count)


def _between_nodes(kept: FloatArray, nodes: VisibilityNodes) -> FloatArray:
    """Weights ``[K, J]`` that interpolate values at ``kept [K]`` to ``nodes``; linear beyond."""
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415  slow to import

    spline = make_interp_spline(kept, np.eye(kept.size), k=3)
    u, slope = np.clip(nodes.u, kept[0], kept[-1]), spline.derivative()
    return np.asarray(spline(u) + slope(u) * (nodes.u - u)[:, None], dtype=np.float64).T


def _known(graph: StateGraph, solved: _Solved) -> tuple[KnownValues, ...]:
    """What the proposal looks up, of states that more than a negligible share leads by."""
    known: list[KnownValues] = []
    following = np.empty(0, dtype=np.int64)
    for index in reversed(range(len(graph.layers))):
        layer = graph.layers[index]
        chosen = np.flatnonzero(counting(solved.pooled, index))
        columns = [column[chosen] for column in state_columns(layer.states)]
        keys = cell_keys(columns, [MERGE_DISTANCE] * len(columns))
        order = np.argsort(keys)
        chosen = chosen[order]
        place = np.append(following, [UNSAFE_NODE, SAFE_NODE])  # indices -2 and -1
        one = KnownValues(
            keys=keys[order],
            after_miss=place[layer.after_miss[chosen]],
            after_hit=place[layer.after_hit[chosen]],
            log_value=solved.log_value[index][chosen],
        )
        known.insert(0, one)
        following = np.full(layer.count, SAFE_NODE, dtype=np.int64)
        following[chosen] = np.arange(chosen.size)
    return tuple(known)
