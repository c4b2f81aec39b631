"""Probabilities of violation over the graph of states: one recursion backward, one forward."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.sampling.zero_variance.reachable_states import Layer, Pause, StateGraph, no_pause


@dataclass(frozen=True)
class Values:
    """Log probabilities over the layers of a graph [nats].

    Attributes:
        log_value: By layer ``[n]``, the log probability of violation from each state.
        log_reached: By layer ``[n]``, the log probability of coming through each state.
        proposal_logit: By layer ``[n]``, logit of 'detected' given that the rollout violates.
        log_probability: Log of the failure probability; -inf where it is 0.
        log_start_value: Of that from each start, ``[K]``.
    """

    log_value: tuple[FloatArray, ...]
    log_reached: tuple[FloatArray, ...]
    proposal_logit: tuple[FloatArray, ...]
    log_probability: float
    log_start_value: FloatArray = field(default_factory=lambda: np.zeros(0))


def solve(graph: StateGraph, *, pause: Pause = no_pause) -> Values:
    """Backward for the probability of violation, forward for that of being reached.

    ``pause`` is called once a layer and direction.
    """
    layers = graph.layers
    log_value: list[FloatArray] = []
    proposal_logit: list[FloatArray] = []
    following = np.empty(0)
    for layer in reversed(layers):
        pause()
        miss, hit = _outcome_values(layer, following)
        following = np.logaddexp(miss, hit)
        log_value.insert(0, following)
        proposal_logit.insert(0, _difference(hit, miss))
    log_reached = [_begun(graph)] if layers else []
    for layer, after in itertools.pairwise(layers):
        pause()
        log_reached.append(_reached(layer, log_reached[-1], after.count))
    of_start = _start_values(graph, log_value)
    return Values(
        log_value=tuple(log_value),
        log_reached=tuple(log_reached),
        proposal_logit=tuple(proposal_logit),
        log_probability=float(np.logaddexp.reduce(graph.log_start + of_start)),
        log_start_value=of_start,
    )


def log_values(graph: StateGraph, *, pause: Pause = no_pause) -> tuple[FloatArray, ...]:
    """By layer ``[n]`` the log probability of violation alone; ``pause`` as above."""
    found: list[FloatArray] = []
    following = np.empty(0)
    for layer in reversed(graph.layers):
        pause()
        following = np.logaddexp(*_outcome_values(layer, following))
        found.insert(0, following)
    return tuple(found)


def log_value_at_start(graph: StateGraph, *, pause: Pause = no_pause) -> float:
    """Log of the failure probability alone; -inf where it is 0. ``pause`` as above."""
    of_start = _start_values(graph, log_values(graph, pause=pause))
    return float(np.logaddexp.reduce(graph.log_start + of_start))


def _start_values(graph: StateGraph, log_value: Sequence[FloatArray]) -> FloatArray:
    """Log of the probability of violation from each start, ``[K]``."""
    first = log_value[0] if log_value else np.empty(0)
    ends = np.concatenate([first, [0.0, -np.inf]])  # indices -2 and -1
    return ends[np.atleast_1d(graph.start)]


def _begun(graph: StateGraph) -> FloatArray:
    """Log of the probability of starting in each state of the first layer, ``[n]``."""
    node = np.atleast_1d(graph.start)
    inside = node >= 0
    return log_sum_by(node[inside], graph.log_start[inside], graph.layers[0].count)


def both_log_likelihoods(logit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log likelihoods of a miss and of a hit under logits ``[n]`` of 'detected', ``[n]`` each."""
    shared = np.abs(logit)
    np.exp(np.negative(shared, out=shared), out=shared)
    np.log1p(shared, out=shared)  # log(1 + exp(-|logit|)): both have it
    miss, hit = np.maximum(logit, 0.0), np.maximum(-logit, 0.0)
    miss += shared
    hit += shared
    return np.negative(miss, out=miss), np.negative(hit, out=hit)


def log_sum_by(group: IntArray, log_values: FloatArray, count: int) -> FloatArray:
    """Log of the sums of exp of ``log_values [M]`` in each of ``count`` groups."""
    largest = np.full(count, -np.inf)
    np.maximum.at(largest, group, log_values)
    shift = np.where(np.isfinite(largest), largest, 0.0)
    total = np.bincount(group, weights=np.exp(log_values - shift[group]), minlength=count)
    with np.errstate(divide="ignore"):  # log 0 is -inf: nothing arrives there
        return np.log(total) + shift


def _outcome_values(layer: Layer, following: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log of outcome probability times value afterwards, for a miss and a hit, ``[n]``."""
    ends = np.concatenate([following, [0.0, -np.inf]])  # indices -2 and -1
    miss, hit = both_log_likelihoods(layer.pem_logit)
    return miss + ends[layer.after_miss], hit + ends[layer.after_hit]


def _difference(hit: FloatArray, miss: FloatArray) -> FloatArray:
    """Hit - miss, 0 where both are -inf."""
    both = np.isneginf(hit) & np.isneginf(miss)
    return np.where(both, 0.0, np.where(both, 0.0, hit) - np.where(both, 0.0, miss))


def _reached(layer: Layer, log_reached: FloatArray, count: int) -> FloatArray:
    miss, hit = both_log_likelihoods(layer.pem_logit)
    arriving = np.concatenate([log_reached + miss, log_reached + hit])
    node = np.concatenate([layer.after_miss, layer.after_hit])
    arrives = node >= 0
    return log_sum_by(node[arrives], arriving[arrives], count)
