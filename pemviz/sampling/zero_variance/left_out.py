"""What an approximate value function leaves out: states that it calls safe are tried.

Where neighbouring states are taken for one, a state can be called safe from which a violation
is possible. Every rollout that violates by way of such a state enters the safe ones at some
step, so that the probability left out is the sum, over all moves from a live state to a safe
one, of the probability of that move times that of violation from there on. Moves are sampled at
random, and rollouts go on from them with miss rates that know nothing of the value function.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, logsumexp

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray
from pemviz.faults import of_no_rollouts
from pemviz.pem.models.protocol import DetectorModel
from pemviz.sampling.rollouts.simulate import logit_of
from pemviz.sampling.zero_variance.reachable_states import (
    SAFE_NODE,
    Pause,
    StateGraph,
    Unsafe,
    no_pause,
)
from pemviz.sampling.zero_variance.values import Values
from pemviz.simulators.latents import begun, stepped
from pemviz.simulators.quantised import start_cells
from pemviz.types import Simulator, StateBatch, outcome_log_likelihood

ROLLOUTS = 20_000
SEED = 2**62 + 13
LOGITS = (-4.0, -1.5, 0.0, 1.5, 4.0)
"""Of 'detected': one of them up to a step chosen at random, one of them from there on."""
STANDARD_ERRORS = 2.0
LARGEST_LOG = 700.0


@of_no_rollouts()
def left_out_share(
    graph: StateGraph,
    values: Values,
    *,
    twin: Simulator,
    pem: DetectorModel,
    unsafe: Unsafe,
    rollouts: int = ROLLOUTS,
    pause: Pause = no_pause,
) -> float:
    """The share of the failure probability that leads by way of states called safe, 0 to 1.

    By a figure two standard errors above an unbiased estimate; 0 if no rollout from such states
    violates. In ``graph``, which was explored on the ``twin``, states may have been taken for one
    that differ; so many ``rollouts`` go on from those called safe. ``pause`` is called once a step.
    """
    generator = np.random.default_rng(SEED)
    moves = _sampled_moves(graph, values, rollouts, generator)
    trials = _Trials.begun(*_safe_starts(graph, twin, rollouts), twin, generator)
    violating: list[FloatArray] = []
    for step in range(twin.states - 1):
        pause()
        trials = trials.stepped(twin, pem, generator)
        chosen = moves.take(moves.step == step)
        if chosen.step.size:
            entered = stepped(twin, graph.layers[step].states.take(chosen.node), chosen.hit)
            trials = trials.joined(_Trials.begun(entered, chosen.log_weight, twin, generator))
        bad = unsafe(trials.states)
        violating.append(trials.take(bad).chains.log_weight())
        trials = trials.take(~bad)
    return _upper_share(np.concatenate(violating) - values.log_probability, rollouts)


def _safe_starts(graph: StateGraph, twin: Simulator, count: int) -> tuple[StateBatch, FloatArray]:
    """``count`` states at starts that are called safe, each as often, and their log weights."""
    safe = np.flatnonzero(graph.start == SAFE_NODE)
    chosen = np.resize(safe, count if safe.size else 0)
    log_weight = graph.log_start[chosen] + np.log(max(safe.size, 1))
    cells = start_cells(twin)
    at = None if cells is None else cells.medians[chosen]
    return begun(twin, count=chosen.size, start=at), log_weight


@dataclass(frozen=True)
class _Moves(Batch):
    """Moves from live states to states called safe; all arrays ``[N]``.

    Attributes:
        step: Of the live state.
        node: Its index in its layer.
        hit: The outcome.
        log_weight: Log of the probability of the move, over that with which it was sampled.
    """

    step: IntArray
    node: IntArray
    hit: BoolArray
    log_weight: FloatArray


def _sampled_moves(
    graph: StateGraph, values: Values, count: int, generator: np.random.Generator
) -> _Moves:
    """``count`` moves to safe states: half any, half by the square root of their probability."""
    none = np.empty(0, dtype=np.int64)
    parts = [_Moves(none, none, none == 0, none / 1.0)]
    for step, layer in enumerate(graph.layers):
        for hit, node in ((False, layer.after_miss), (True, layer.after_hit)):
            safe = np.flatnonzero(node == SAFE_NODE)
            outcome = np.full(safe.size, hit)
            log_p = outcome_log_likelihood(layer.pem_logit[safe], outcome)
            log_p += values.log_reached[step][safe]
            parts.append(_Moves(np.full(safe.size, step), safe, outcome, log_p))
    every = _Moves.concatenate(parts)
    if every.step.size == 0:
        return every
    root = np.exp((every.log_weight - every.log_weight.max()) / 2.0)
    share = 0.5 / every.step.size + 0.5 * root / root.sum()
    chosen = generator.choice(every.step.size, size=count, p=share / share.sum())
    sampled = every.take(chosen)
    return replace(sampled, log_weight=sampled.log_weight - np.log(share[chosen]))


@dataclass(frozen=True)
class _Chains(Batch):
    """The outcomes of n trials so far.

    Attributes:
        log_p: Log of their probability, and of the weight before, ``[n]``.
        switch: The step up to which the first of two logits is sampled from, ``[n]``.
        logits: The two, ``[n, 2]``.
        outcomes: How many misses and detections there were under either, ``[n, 2, 2]``.
    """

    log_p: FloatArray
    switch: IntArray
    logits: FloatArray
    outcomes: IntArray

    def log_weight(self) -> FloatArray:
        """Over the probability of the outcomes under any of the logits (balance heuristic)."""
        under = [
            outcome_log_likelihood(np.array(LOGITS), np.full(len(LOGITS), hit))
            for hit in (False, True)
        ]
        log_q = logsumexp(self.outcomes @ np.stack(under), axis=2) - np.log(len(LOGITS))
        return self.log_p - log_q.sum(axis=1)


@dataclass(frozen=True)
class _Trials:
    """Rollouts on their way, all at one step: where they are, and what led there."""

    states: StateBatch
    chains: _Chains

    @staticmethod
    def begun(
        states: StateBatch, log_weight: FloatArray, twin: Simulator, generator: np.random.Generator
    ) -> "_Trials":
        count = log_weight.size
        chains = _Chains(
            log_p=log_weight,
            switch=generator.integers(0, twin.states, size=count),
            logits=generator.choice(LOGITS, size=(count, 2)),
            outcomes=np.zeros((count, 2, 2), dtype=np.int64),
        )
        return _Trials(states, chains)

    def joined(self, other: "_Trials") -> "_Trials":
        return _Trials(
            StateBatch.concatenate([self.states, other.states]),
            _Chains.concatenate([self.chains, other.chains]),
        )

    def take(self, rows: BoolArray) -> "_Trials":
        return _Trials(self.states.take(rows), self.chains.take(rows))

    def stepped(
        self, twin: Simulator, pem: DetectorModel, generator: np.random.Generator
    ) -> "_Trials":
        """One step on, with outcomes sampled by the trials' own logits."""
        states, chains = self.states, self.chains
        count = chains.log_p.size
        if count == 0:
            return replace(self, states=replace(states, step=states.step + 1))
        rows, part = np.arange(count), (states.step >= chains.switch).astype(np.int64)
        hit = generator.random(count) >= expit(-chains.logits[rows, part])
        outcomes = chains.outcomes.copy()
        outcomes[rows, part, hit.astype(np.int64)] += 1
        under_pem = outcome_log_likelihood(logit_of(pem, twin.salient(states.signals)), hit)
        return _Trials(
            stepped(twin, states, hit),
            replace(chains, log_p=chains.log_p + under_pem, outcomes=outcomes),
        )


def _upper_share(log_terms: FloatArray, count: int) -> float:
    """Share of x in 1 + x; x is two standard errors above the mean of ``count`` terms.

    All but the terms given are 0.
    """
    if log_terms.size and log_terms.max() > LARGEST_LOG:
        return 1.0
    terms = np.zeros(count)
    terms[: log_terms.size] = np.exp(log_terms)
    upper = terms.mean() + STANDARD_ERRORS * terms.std(ddof=1) / np.sqrt(count)
    return float(upper / (1.0 + upper))
