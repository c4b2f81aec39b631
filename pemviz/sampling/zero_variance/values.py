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
        none = np.isneginf(hit) & np.isneginf(miss)
        logit = np.where(none, 0.0, np.where(none, 0.0, hit) - np.where(none, 0.0, miss))
        proposal_logit.insert(0, logit)
    log_reached: list[FloatArray] = []
    if layers:
        inside = graph.start >= 0
        arriving = graph.log_start[inside]
        log_reached.append(log_sum_by(graph.start[inside], arriving, layers[0].count))
    for layer, after in itertools.pairwise(layers):
        pause()
        miss, hit = both_log_likelihoods(layer.pem_logit)
        arriving = np.concatenate([log_reached[-1] + miss, log_reached[-1] + hit])
        node = np.concatenate([layer.after_miss, layer.after_hit])
        inside = node >= 0
        log_reached.append(log_sum_by(node[inside], arriving[inside], after.count))
    log_start_value = _start_values(graph, log_value)
    return Values(
        log_value=tuple(log_value),
        log_reached=tuple(log_reached),
        proposal_logit=tuple(proposal_logit),
        log_probability=float(np.logaddexp.reduce(graph.log_start + log_start_value)),
        log_start_value=log_start_value,
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
    log_start_value = _start_values(graph, log_values(graph, pause=pause))
    return float(np.logaddexp.reduce(graph.log_start + log_start_value))


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


def _start_values(graph: StateGraph, log_value: Sequence[FloatArray]) -> FloatArray:
    """Log of the probability of violation from each start, ``[K]``."""
    return _with_ends(log_value[0] if log_value else np.empty(0))[graph.start]


def _outcome_values(layer: Layer, following: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log of outcome probability times value afterwards, for a miss and a hit, ``[n]``."""
    ends = _with_ends(following)
    miss, hit = both_log_likelihoods(layer.pem_logit)
    return miss + ends[layer.after_miss], hit + ends[layer.after_hit]


def _with_ends(log_value: FloatArray) -> FloatArray:
    """Log values of a layer's states, and those at UNSAFE_NODE and SAFE_NODE: indices -2 and -1."""
    return np.concatenate([log_value, [0.0, -np.inf]])
