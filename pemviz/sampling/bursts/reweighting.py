"""Rollouts that serve many memories: from which proposals, and how likely with each memory.

With misses that hang together as ``memory`` says (:mod:`pemviz.pem.models.memory`), an obstacle's
visibility u is integrated out by the nodes u_j and weights w_j of
:class:`pemviz.pem.models.memory.VisibilityNodes`::

    log p(o_1 .. o_t) = log sum_j w_j prod_s P(o_s | s, o_{s-1}, u_j)
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, ndtr

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray, log_sum_exp
from pemviz.pem import Pem
from pemviz.pem.models.memory import Memory, VisibilityNodes, miss_quantile, persistence
from pemviz.proposals import offset_logistic as logistic
from pemviz.proposals.exploration import ExplorationFamily
from pemviz.proposals.offset_logistic import OffsetLogisticProposal, PolynomialBasis, StateFeatures
from pemviz.sampling.mixture.balance_heuristic import Decisions, Pool, balance_weights
from pemviz.sampling.mixture.pooling import DEGREE
from pemviz.sampling.mixture.stages import defence
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.state.composed import ComposedFeatures, ComposedPem
from pemviz.sampling.state.hidden import HiddenProperty
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.sampling.state.visibility import GivenVisibility
from pemviz.types import (
    LAST_OUTCOME,
    VIOLATED,
    Proposal,
    RolloutBatch,
    ScoredRollouts,
    StateBatch,
    outcome_log_likelihood,
)

ALWAYS = 4.0
"""Nodes within so many standard deviations are always looked at,"""
NOTHING = 40.0
"""and beyond them those that are not so many nats below the most likely one."""


@dataclass(frozen=True)
class Outcomes(Batch):
    """Outcomes before a violation, in the order of rollouts.

    Attributes:
        rollout: Which rollout, ``[M]``.
        step: Which of its outcomes, ``[M]``.
        basis: ``[M, B]``.
        missed: ``[M]``.
        last: The outcome before: missed (-1), detected (1), none (0), ``[M]``.
        logit: Of 'detected' under the model of single outcomes, ``[M]``.
        matters: Whether the scenario itself reacts, ``[M]``.
    """

    rollout: IntArray
    step: IntArray
    basis: FloatArray
    missed: BoolArray
    last: FloatArray
    logit: FloatArray
    matters: BoolArray

    def summed(self, log_p: FloatArray, count: int) -> FloatArray:
        """Of ``[M]`` over each of N rollouts, ``[N]``."""
        return np.bincount(self.rollout, weights=log_p, minlength=count).astype(np.float64)

    def under_logits(self, logit: FloatArray, count: int) -> FloatArray:
        """Log likelihood of N rollouts' outcomes ``[N]``, under logits of 'detected' ``[M]``."""
        return self.summed(outcome_log_likelihood(logit, ~self.missed), count)


def over_visibility(
    outcomes: Outcomes, memory: Memory, *, dt_s: float, count: int
) -> tuple[FloatArray, FloatArray]:
    """Log likelihood of N rollouts' outcomes over all u, and posterior mean of u, ``[N]`` each.

    Under a frailty above 0. Nodes are taken from the middle outwards, until they add nothing to any
    rollout.
    """
    nodes = VisibilityNodes(memory.frailty)
    log_p = _given_visibility(outcomes, memory, dt_s=dt_s)
    middle = nodes.u.size // 2
    found: dict[int, FloatArray] = {}
    largest = np.full(count, -np.inf)
    for outwards in (range(middle, nodes.u.size), range(middle - 1, -1, -1)):
        for place in outwards:
            joint = nodes.log_weight[place] + outcomes.summed(log_p(nodes.u[place]), count)
            found[place] = joint
            np.maximum(largest, joint, out=largest)
            near = abs(nodes.u[place]) < ALWAYS or place == middle
            if not near and not (joint > largest - NOTHING).any():
                break
    order = sorted(found)
    u, log_joint = nodes.u[order], np.stack([found[place] for place in order])
    share = np.exp(log_joint - np.max(log_joint, axis=0))
    return np.asarray(log_sum_exp(log_joint, axis=0)), (u @ share) / share.sum(axis=0)


def _given_visibility(
    outcomes: Outcomes, memory: Memory, *, dt_s: float
) -> Callable[[float], FloatArray]:
    """Log probabilities ``[M]`` of outcomes given u.

    Phi(quantile + slope u); times 1 - rho where an outcome came before, plus rho where it was the
    same.
    """
    sign = np.where(outcomes.missed, 1.0, -1.0)
    rho = float(persistence(dt_s, memory.tau_s))
    is_again = (sign * outcomes.last < 0.0) & (rho > 0.0)
    again, fresh = np.flatnonzero(is_again), np.flatnonzero(~is_again)
    log_fresh = np.where(outcomes.last == 0.0, 0.0, math.log1p(-rho))[~is_again]
    quantile = sign * miss_quantile(outcomes.logit) * math.sqrt(1.0 + memory.frailty**2)
    slope = sign * memory.frailty

    def log_probability(u: float) -> FloatArray:
        moved = quantile + slope * u
        if rho == 0.0:
            return log_ndtr(moved)
        log_p = np.empty(moved.size)
        log_p[fresh] = log_ndtr(moved[fresh]) + log_fresh
        log_p[again] = np.log(rho + (1.0 - rho) * ndtr(moved[again]))
        return log_p

    return log_probability


@dataclass(frozen=True)
class Given:
    """How misses hang together, and the visibility of the obstacle at hand."""

    memory: Memory
    u: float = 0.0


@dataclass(frozen=True)
class FittedAround:
    """A fitted proposal: coefficients ``[B]``, around a model."""

    around: Given
    coefficients: FloatArray


@dataclass(frozen=True)
class Scenario:
    """What rollouts are sampled on, and what is looked at.

    Attributes:
        problem: With the last outcome as a signal, and an absorbing violation.
        pem: The model of single outcomes.
        own_features: What the scenario itself offers to look at.
        memories: How misses may hang together, each.
        explored: The models that a family of exploration proposals is around, each.
        forgetful: Whether none of the memories has a memory time. Outcomes to which the scenario
            does not react then change nothing that comes after, neither states nor what proposals
            do: summed over them a likelihood is that of the other outcomes. They are left out of
            all, unless the exploration proposals' rollouts show that the scenario does react.
        basis: Of the proposals; chosen from the exploration proposals' rollouts.
    """

    problem: Problem
    pem: Pem
    own_features: StateFeatures
    memories: tuple[Memory, ...]
    explored: tuple[Given, ...]
    forgetful: bool = False
    basis: PolynomialBasis | None = None

    @property
    def steps(self) -> int:
        """Outcomes of a rollout."""
        return self.problem.simulator.states - 1

    @property
    def known_basis(self) -> PolynomialBasis:
        """That of the proposals, once it is chosen."""
        assert self.basis is not None  # noqa: S101  from the exploration proposals' rollouts
        return self.basis

    def model(self, given: Given) -> ComposedPem:
        """The error model given an obstacle's visibility, and the outcome before."""
        properties: tuple[HiddenProperty, ...] = (self._last_outcome(given),)
        if given.memory.frailty > 0.0:
            properties = (GivenVisibility(given.memory.frailty, given.u), *properties)
        return ComposedPem(self.pem, properties)

    def model_logit(self, outcomes: Outcomes, given: Given) -> FloatArray:
        """Logit of 'detected' under that model, ``[M]``."""
        return self.model(given).after(outcomes.logit, outcomes.last[:, None])

    def ignores(self, given: Given) -> bool:
        """Whether proposals around a model leave it only where the scenario itself reacts."""
        return self.forgetful or self._last_outcome(given).for_proposals().ignores

    def features(self, given: Given) -> StateFeatures:
        """What proposals around a model look at, and where they act."""
        if self.forgetful:
            return self.own_features
        return ComposedFeatures(self.own_features, (self._last_outcome(given).for_proposals(),))

    def _last_outcome(self, given: Given) -> LastOutcome:
        return LastOutcome(given.memory.tau_s, self.problem.simulator.dt_s)

    def sampled_by_exploration(self, each: int, seeds: np.random.SeedSequence) -> ScoredRollouts:
        """``each`` rollouts from every family of exploration proposals."""
        found: list[ScoredRollouts] = []
        for given, child in zip(self.explored, seeds.spawn(len(self.explored)), strict=True):
            exploration = ExplorationFamily.over(self.steps).sampled(
                each,
                np.random.default_rng(child.spawn(1)[0]),
                features=self.features(given),
                violated=VIOLATED,
            )
            found.append(self._sampled(exploration, given, each, child))
        return ScoredRollouts.concatenate(found)

    def sampled_by_fit(
        self, fit: FittedAround, count: int, seeds: np.random.SeedSequence
    ) -> ScoredRollouts:
        """``count`` rollouts from a fitted proposal."""
        proposal = OffsetLogisticProposal(
            features=self.features(fit.around),
            basis=self.known_basis,
            coefficients=fit.coefficients,
            violated=VIOLATED,
            defensive=defence(self.steps),
        )
        return self._sampled(proposal, fit.around, count, seeds)

    def _sampled(
        self, proposal: Proposal, given: Given, count: int, seeds: np.random.SeedSequence
    ) -> ScoredRollouts:
        problem = replace(self.problem, pem=self.model(given))
        return sample(problem, proposal=proposal, count=count, seeds=seeds)


@dataclass(frozen=True)
class Sampled:
    """N rollouts and K proposals, beside exploration proposals.

    Attributes:
        outcomes: Of all rollouts.
        component: What each was sampled from, ``[N]``: 0 is the exploration proposals' families, k
            the k-th proposal.
        log_q: Log likelihood under the exploration proposals and under each proposal, ``[N, 1 +
            K]`` [nats].
        lowered: By how much ``log_q`` is lowered of what proposals were fitted to, ``[N, 1 + K]``.
        log_p: The same under the error model with each memory, ``[N, A]``.
        visibility: Posterior mean of the obstacle's visibility u, ``[N, A]``.
        robustness: ``[N]``.
        violated: ``[N]``.
    """

    outcomes: Outcomes
    component: IntArray
    log_q: FloatArray
    lowered: FloatArray
    log_p: FloatArray
    visibility: FloatArray
    robustness: FloatArray
    violated: BoolArray

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return int(self.violated.size)

    def log_weight(self, place: int) -> FloatArray:
        """Of every rollout for one of the memories, by the balance heuristic, ``[N]``."""
        return balance_weights(self.log_q - self.log_p[:, place, None], self.component)


def first_basis(scenario: Scenario, scored: ScoredRollouts) -> PolynomialBasis:
    """Monomials of the features, standardised by the first rollouts."""
    values = _values(scenario, *_counting(scenario, scored.rollouts))
    return PolynomialBasis.standardised_by(values, degree=DEGREE)


def described(
    scenario: Scenario, scored: ScoredRollouts, fits: Sequence[FittedAround], *, component: int
) -> Sampled:
    """Rollouts sampled from one component, with their likelihood under all."""
    rollouts, count = scored.rollouts, scored.rollouts.count
    states, counting = _counting(scenario, rollouts)
    salient = scenario.problem.simulator.salient(states.signals)
    own_logit, last = scenario.pem.logit(salient[..., :-1]), salient[..., -1]
    matters = np.broadcast_to(scenario.own_features.reacts(states), counting.shape)
    outcomes = Outcomes(
        rollout=np.nonzero(counting)[0].astype(np.int64),
        step=np.nonzero(counting)[1].astype(np.int64),
        basis=scenario.known_basis.evaluate(_values(scenario, states, counting)),
        missed=~rollouts.detected[counting],
        last=last[counting],
        logit=own_logit[counting],
        matters=matters[counting],
    )
    by_family = [
        outcomes.under_logits(scenario.model_logit(outcomes, given), count)
        + ExplorationFamily.over(scenario.steps).log_ratio(
            replace(rollouts, pem_logit=scenario.model(given).after(own_logit, last[..., None])),
            counting & matters if scenario.ignores(given) else counting,
        )
        for given in scenario.explored
    ]
    by_exploration = log_sum_exp(np.asarray(by_family), axis=0) - np.log(len(by_family))
    by_fits = [_log_q(scenario, outcomes, fit, count) for fit in fits]
    log_p: list[FloatArray] = []
    visibility: list[FloatArray] = []
    for memory in scenario.memories:
        if memory.frailty == 0.0:
            logit = scenario.model_logit(outcomes, Given(memory))
            log_p.append(outcomes.under_logits(logit, count))
            visibility.append(np.zeros(count))
        else:
            dt_s = scenario.problem.simulator.dt_s
            of_all, mean = over_visibility(outcomes, memory, dt_s=dt_s, count=count)
            log_p.append(of_all)
            visibility.append(mean)
    log_q = np.stack([by_exploration, *by_fits], axis=1)
    return Sampled(
        outcomes=outcomes,
        component=np.full(count, component, dtype=np.int64),
        log_q=log_q,
        lowered=np.zeros_like(log_q),
        log_p=np.stack(log_p, axis=1),
        visibility=np.stack(visibility, axis=1),
        robustness=scored.robustness,
        violated=scored.violated,
    )


def with_fit(
    scenario: Scenario, sampled: Sampled, fit: FittedAround, *, optimism: FloatArray
) -> Sampled:
    """The rollouts with their likelihood under one more proposal, which was fitted to them.

    ``optimism`` is by how much it overstates their log likelihood for that reason, ``[N]``.
    """
    log_q = _log_q(scenario, sampled.outcomes, fit, sampled.count) - optimism
    return replace(
        sampled,
        log_q=np.column_stack([sampled.log_q, log_q]),
        lowered=np.column_stack([sampled.lowered, optimism]),
    )


def joined(before: Sampled, fresh: Sampled) -> Sampled:
    """Both, of the same proposals."""
    shifted = replace(fresh.outcomes, rollout=fresh.outcomes.rollout + before.count)
    return Sampled(
        outcomes=Outcomes.concatenate([before.outcomes, shifted]),
        component=np.concatenate([before.component, fresh.component]),
        log_q=np.concatenate([before.log_q, fresh.log_q]),
        lowered=np.concatenate([before.lowered, fresh.lowered]),
        log_p=np.concatenate([before.log_p, fresh.log_p]),
        visibility=np.concatenate([before.visibility, fresh.visibility]),
        robustness=np.concatenate([before.robustness, fresh.robustness]),
        violated=np.concatenate([before.violated, fresh.violated]),
    )


def seen_at(scenario: Scenario, sampled: Sampled, place: int, *, u: float = 0.0) -> Pool:
    """The rollouts as samples for one memory, with the decisions that its proposals make.

    The memory is given by its place among all; proposals are around the visibility ``u``.
    """
    given = Given(scenario.memories[place], u)
    outcomes = sampled.outcomes
    decisions = Decisions(
        rollout=outcomes.rollout,
        basis=outcomes.basis,
        missed=outcomes.missed,
        offset=-scenario.model_logit(outcomes, given),
        step=outcomes.step,
    )
    if scenario.ignores(given):
        decisions = decisions.take(outcomes.matters)
    log_p = sampled.log_p[:, place]
    return Pool(
        decisions=decisions,
        component=sampled.component,
        proposals=(),
        log_ratio=sampled.log_q - log_p[:, None],
        robustness=sampled.robustness,
        violated=sampled.violated,
        log_p=log_p,
        lowered=sampled.lowered,
    )


def is_indifferent(scenario: Scenario, rollouts: RolloutBatch) -> bool:
    """Whether rollouts go on as they did with all outcomes turned that the scenario ignores."""
    reacts = np.broadcast_to(
        scenario.own_features.reacts(rollouts.decision_states()), rollouts.detected.shape
    )
    latents = rollouts.latents
    again = replay(
        simulator=scenario.problem.simulator,
        detected=rollouts.detected ^ ~reacts,
        start=None if latents is None else latents.start,
        noise=None if latents is None else latents.noise,
    )
    own = (name for name in rollouts.signals if name != LAST_OUTCOME.name)
    return all(np.array_equal(rollouts.signals[name], again[name], equal_nan=True) for name in own)


def _counting(scenario: Scenario, rollouts: RolloutBatch) -> tuple[StateBatch, BoolArray]:
    """States at which outcomes are decided, and which outcomes ``[N, T-1]`` count.

    Those before a violation, if a rollout knows of it; of a forgetful scenario those that matter.
    """
    states, shape = rollouts.decision_states(), rollouts.detected.shape
    violated = rollouts.memory.get(VIOLATED)
    counting = np.ones(shape, dtype=np.bool_) if violated is None else ~violated[:, : shape[1]]
    if scenario.forgetful:
        counting = counting & scenario.own_features.reacts(states)
    return states, counting


def _values(scenario: Scenario, states: StateBatch, counting: BoolArray) -> FloatArray:
    """What proposals look at where outcomes count, ``[M, D]``."""
    values = scenario.features(Given(scenario.memories[0])).values(states)
    return np.broadcast_to(values, (*counting.shape, values.shape[-1]))[counting]


def _log_q(scenario: Scenario, outcomes: Outcomes, fit: FittedAround, count: int) -> FloatArray:
    """Log likelihood of N rollouts' outcomes under a fitted proposal, ``[N]``."""
    under_pem = scenario.model_logit(outcomes, fit.around)
    raised = logistic.shift(outcomes.basis, fit.coefficients)
    logit = logistic.defended(under_pem - raised, under_pem, share=defence(scenario.steps))
    if scenario.ignores(fit.around):
        logit = np.where(outcomes.matters, logit, under_pem)
    return outcomes.under_logits(logit, count)
