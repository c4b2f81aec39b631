"""Rollouts that serve many memories: from which proposals, and how likely with each memory.

With misses that hang together as ``memory`` says (:mod:`pemviz.pem.models.memory`), an obstacle's
visibility u is integrated out by the nodes u_j and weights w_j of
:class:`pemviz.pem.models.memory.VisibilityNodes`::

    log p(o_1 .. o_t) = log sum_j w_j prod_s P(o_s | s, o_{s-1}, u_j)
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, ndtr

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray, log_sum_exp
from pemviz.pem import Pem
from pemviz.pem.models.memory import Memory, VisibilityNodes, miss_quantile, persistence
from pemviz.proposals.exploration import ExplorationFamily
from pemviz.proposals.offset_logistic import (
    OffsetLogisticProposal,
    PolynomialBasis,
    StateFeatures,
    defended,
    share_for,
    shift,
)
from pemviz.sampling.mixture.balance_heuristic import Decisions, Pool, balance_weights
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.state.composed import ComposedFeatures, ComposedPem
from pemviz.sampling.state.hidden import HiddenProperty
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.sampling.state.visibility import GivenVisibility
from pemviz.simulators.absorbing import VIOLATED
from pemviz.types import (
    LAST_OUTCOME,
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
DEFENSIVE_STEPS = 2.0
DEGREE = 3


@dataclass(frozen=True)
class Outcomes(Batch):
    """Outcomes before a violation, in the order of rollouts.

    Attributes:
        rollout: Which rollout, ``[M]``.
        basis: ``[M, B]``.
        missed: ``[M]``.
        last: The outcome before: missed (-1), detected (1), none (0), ``[M]``.
        logit: Of 'detected' under the model of single outcomes, ``[M]``.
        matters: Whether the scenario itself reacts, ``[M]``.
    """

    rollout: IntArray
    basis: FloatArray
    missed: BoolArray
    last: FloatArray
    logit: FloatArray
    matters: BoolArray


def under_logits(outcomes: Outcomes, logit: FloatArray, *, count: int) -> FloatArray:
    """Log likelihood of N rollouts' outcomes ``[N]``, under logits of 'detected' ``[M]``."""
    return _summed(outcomes, outcome_log_likelihood(logit, ~outcomes.missed), count)


@dataclass(frozen=True)
class ByNode:
    """What each visibility has to do with N rollouts.

    Attributes:
        u: Nodes, ``[J]``.
        log_joint: Log of weight times likelihood, ``[J, N]``.
    """

    u: FloatArray
    log_joint: FloatArray

    @property
    def log_likelihood(self) -> FloatArray:
        """With u integrated out, ``[N]``."""
        return np.asarray(log_sum_exp(self.log_joint, axis=0))

    @property
    def mean(self) -> FloatArray:
        """Posterior mean of u, ``[N]``."""
        share = np.exp(self.log_joint - np.max(self.log_joint, axis=0))
        return (self.u @ share) / share.sum(axis=0)


def by_node(outcomes: Outcomes, memory: Memory, *, dt_s: float, count: int) -> ByNode:
    """Outcomes of N rollouts under a frailty above 0.

    Nodes are taken from the middle outwards, until they add nothing to any rollout.
    """
    nodes = VisibilityNodes(memory.frailty)
    given = _GivenVisibility.of(outcomes, memory, dt_s=dt_s)
    middle = nodes.u.size // 2
    found: dict[int, FloatArray] = {}
    largest = np.full(count, -np.inf)

    def is_needed(place: int) -> bool:
        joint = nodes.log_weight[place] + _summed(outcomes, given.log_p(nodes.u[place]), count)
        found[place] = joint
        np.maximum(largest, joint, out=largest)
        near = abs(nodes.u[place]) < ALWAYS or place == middle
        return near or bool((joint > largest - NOTHING).any())

    for outwards in (range(middle, nodes.u.size), range(middle - 1, -1, -1)):
        for place in outwards:
            if not is_needed(place):
                break
    order = sorted(found)
    return ByNode(nodes.u[order], np.stack([found[place] for place in order]))


@dataclass(frozen=True)
class _GivenVisibility:
    """Outcomes' probabilities given u.

    Phi(quantile + slope u); times 1 - rho where an outcome came before, plus rho where it was the
    same.
    """

    quantile: FloatArray
    slope: FloatArray
    again: IntArray
    fresh: IntArray
    log_fresh: FloatArray
    rho: float

    @staticmethod
    def of(outcomes: Outcomes, memory: Memory, *, dt_s: float) -> "_GivenVisibility":
        """Of M outcomes."""
        sign = np.where(outcomes.missed, 1.0, -1.0)
        rho = float(persistence(dt_s, memory.tau_s))
        again = (sign * outcomes.last < 0.0) & (rho > 0.0)
        after_any = np.where(outcomes.last == 0.0, 0.0, math.log1p(-rho))
        return _GivenVisibility(
            quantile=sign * miss_quantile(outcomes.logit) * math.sqrt(1.0 + memory.frailty**2),
            slope=sign * memory.frailty,
            again=np.flatnonzero(again),
            fresh=np.flatnonzero(~again),
            log_fresh=after_any[~again],
            rho=rho,
        )

    def log_p(self, u: float) -> FloatArray:
        """Log probabilities ``[M]``."""
        moved = self.quantile + self.slope * u
        if self.rho == 0.0:
            return log_ndtr(moved)
        log_p = np.empty(moved.size)
        log_p[self.fresh] = log_ndtr(moved[self.fresh]) + self.log_fresh
        log_p[self.again] = np.log(self.rho + (1.0 - self.rho) * ndtr(moved[self.again]))
        return log_p


def _summed(outcomes: Outcomes, log_p: FloatArray, count: int) -> FloatArray:
    return np.bincount(outcomes.rollout, weights=log_p, minlength=count).astype(np.float64)


@dataclass(frozen=True)
class Given:
    """How misses hang together, and the visibility of the obstacle at hand."""

    memory: Memory
    u: float = 0.0


@dataclass(frozen=True)
class Drawing:
    """A fitted proposal: coefficients ``[B]``, around a model."""

    around: Given
    coefficients: FloatArray


@dataclass(frozen=True)
class Scenario:
    """What rollouts are drawn on, and what is looked at.

    Attributes:
        problem: With the last outcome as a signal, and an absorbing violation.
        pem: The model of single outcomes.
        own_features: What the scenario itself offers to look at.
        asked: How misses may hang together, each.
        explored: The models that a family of exploration proposals is around, each.
        forgetful: Whether no memory that is asked about has a memory time. Outcomes to which the
            scenario does not react then change nothing that comes after, neither states nor what
            proposals do: summed over them a likelihood is that of the other outcomes. They are
            left out of all, unless the exploration proposals' rollouts show that the scenario does
            react.
        basis: Of the proposals; chosen from the exploration proposals' rollouts.
    """

    problem: Problem
    pem: Pem
    own_features: StateFeatures
    asked: tuple[Memory, ...]
    explored: tuple[Given, ...]
    forgetful: bool = False
    basis: PolynomialBasis | None = None

    @property
    def steps(self) -> int:
        """Outcomes of a rollout."""
        return self.problem.simulator.states - 1

    @property
    def defensive(self) -> float:
        """Share of the model in every outcome's probability."""
        return share_for(drawn_steps=DEFENSIVE_STEPS, steps=self.steps)

    def model(self, given: Given) -> ComposedPem:
        """The error model given an obstacle's visibility, and the outcome before."""
        properties: tuple[HiddenProperty, ...] = (self._last_outcome(given),)
        if given.memory.frailty > 0.0:
            properties = (GivenVisibility(given.memory.frailty, given.u), *properties)
        return ComposedPem(self.pem, properties)

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

    def proposal(self, drawing: Drawing) -> OffsetLogisticProposal:
        """What rollouts are drawn from."""
        assert self.basis is not None  # noqa: S101  chosen from the exploration proposals' rollouts
        return OffsetLogisticProposal(
            features=self.features(drawing.around),
            basis=self.basis,
            coefficients=drawing.coefficients,
            violated=VIOLATED,
            defensive=self.defensive,
        )


def sampled_by_exploration(
    scenario: Scenario, *, each: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    """``each`` rollouts from every family of exploration proposals."""
    return ScoredRollouts.concatenate(list(_by_family(scenario, each, seeds)))


def _by_family(
    scenario: Scenario, each: int, seeds: np.random.SeedSequence
) -> Iterator[ScoredRollouts]:
    families = len(scenario.explored)
    for given, child in zip(scenario.explored, seeds.spawn(families), strict=True):
        exploration = ExplorationFamily.over(scenario.steps).drawn(
            each,
            np.random.default_rng(child.spawn(1)[0]),
            features=scenario.features(given),
            violated=VIOLATED,
        )
        yield _sampled(scenario, exploration, given, each, child)


def sampled_by_fit(
    scenario: Scenario, drawing: Drawing, *, count: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    """``count`` rollouts from a fitted proposal."""
    return _sampled(scenario, scenario.proposal(drawing), drawing.around, count, seeds)


def _sampled(
    scenario: Scenario, proposal: Proposal, given: Given, count: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    problem = replace(scenario.problem, pem=scenario.model(given))
    return sample(problem, proposal=proposal, count=count, seeds=seeds)


@dataclass(frozen=True)
class Drawn:
    """N rollouts and K proposals, beside exploration proposals.

    Attributes:
        outcomes: Of all rollouts.
        component: What each was drawn from, ``[N]``: 0 is the exploration proposals' families, k
            the k-th proposal.
        log_q: Log likelihood under the exploration proposals and under each proposal, ``[N, 1 +
            K]`` [nats].
        log_p: The same under the error model with each memory that was asked for, ``[N, A]``.
        visibility: Posterior mean of the obstacle's visibility u, ``[N, A]``.
        robustness: ``[N]``.
        violated: ``[N]``.
    """

    outcomes: Outcomes
    component: IntArray
    log_q: FloatArray
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
    """Monomials of the features, standardised by the first rollouts; constants keep spread 1."""
    values = _values(scenario, *_counting(scenario, scored.rollouts))
    spread = np.std(values, axis=0)
    return PolynomialBasis(
        mean=np.mean(values, axis=0), spread=np.where(spread > 0.0, spread, 1.0), degree=DEGREE
    )


def described(
    scenario: Scenario, scored: ScoredRollouts, drawings: Sequence[Drawing], *, component: int
) -> Drawn:
    """Rollouts drawn from one component, with their likelihood under all."""
    assert scenario.basis is not None  # noqa: S101  chosen from the exploration proposals' rollouts
    rollouts = scored.rollouts
    states, counting = _counting(scenario, rollouts)
    salient = scenario.problem.simulator.salient(states.signals)
    own_logit, last = scenario.pem.logit(salient[..., :-1]), salient[..., -1]
    matters = np.broadcast_to(scenario.own_features.reacts(states), counting.shape)
    outcomes = Outcomes(
        rollout=np.nonzero(counting)[0].astype(np.int64),
        basis=scenario.basis.evaluate(_values(scenario, states, counting)),
        missed=~rollouts.detected[counting],
        last=last[counting],
        logit=own_logit[counting],
        matters=matters[counting],
    )
    by_family = [
        under_logits(outcomes, model_logit(scenario, outcomes, given), count=rollouts.count)
        + ExplorationFamily.over(scenario.steps).log_ratio(
            replace(rollouts, pem_logit=scenario.model(given).after(own_logit, last[..., None])),
            counting & matters if scenario.ignores(given) else counting,
        )
        for given in scenario.explored
    ]
    by_exploration = log_sum_exp(np.asarray(by_family), axis=0) - np.log(len(by_family))
    by_fits = [_log_q(scenario, outcomes, drawing, rollouts.count) for drawing in drawings]
    likely = [_likely(scenario, outcomes, memory, rollouts.count) for memory in scenario.asked]
    return Drawn(
        outcomes=outcomes,
        component=np.full(rollouts.count, component, dtype=np.int64),
        log_q=np.stack([by_exploration, *by_fits], axis=1),
        log_p=np.stack([log_p for log_p, _ in likely], axis=1),
        visibility=np.stack([mean for _, mean in likely], axis=1),
        robustness=scored.robustness,
        violated=scored.violated,
    )


def with_drawing(
    scenario: Scenario, drawn: Drawn, drawing: Drawing, *, optimism: FloatArray
) -> Drawn:
    """The rollouts with their likelihood under one more proposal.

    Args:
        scenario: What they were drawn on.
        drawn: N rollouts.
        drawing: Fitted to them.
        optimism: By how much it overstates their log likelihood for that reason, ``[N]``.
    """
    log_q = _log_q(scenario, drawn.outcomes, drawing, drawn.count) - optimism
    return replace(drawn, log_q=np.column_stack([drawn.log_q, log_q]))


def joined(before: Drawn, fresh: Drawn) -> Drawn:
    """Both, of the same proposals."""
    shifted = replace(fresh.outcomes, rollout=fresh.outcomes.rollout + before.count)
    return Drawn(
        outcomes=Outcomes.concatenate([before.outcomes, shifted]),
        component=np.concatenate([before.component, fresh.component]),
        log_q=np.concatenate([before.log_q, fresh.log_q]),
        log_p=np.concatenate([before.log_p, fresh.log_p]),
        visibility=np.concatenate([before.visibility, fresh.visibility]),
        robustness=np.concatenate([before.robustness, fresh.robustness]),
        violated=np.concatenate([before.violated, fresh.violated]),
    )


def model_logit(scenario: Scenario, outcomes: Outcomes, given: Given) -> FloatArray:
    """Logit of 'detected' under a model given the obstacle's visibility, ``[M]``."""
    return scenario.model(given).after(outcomes.logit, outcomes.last[:, None])


def seen_at(scenario: Scenario, drawn: Drawn, place: int, *, u: float = 0.0) -> Pool:
    """The rollouts as draws for one memory, with the decisions that its proposals make.

    Args:
        scenario: What they were drawn on.
        drawn: N rollouts.
        place: Of the memory among those asked for.
        u: The visibility that the proposals are around.
    """
    given = Given(scenario.asked[place], u)
    outcomes = drawn.outcomes
    decisions = Decisions(
        rollout=outcomes.rollout,
        basis=outcomes.basis,
        missed=outcomes.missed,
        offset=-model_logit(scenario, outcomes, given),
    )
    if scenario.ignores(given):
        decisions = decisions.take(outcomes.matters)
    log_p = drawn.log_p[:, place]
    return Pool(
        decisions=decisions,
        component=drawn.component,
        proposals=(),
        log_ratio=drawn.log_q - log_p[:, None],
        robustness=drawn.robustness,
        violated=drawn.violated,
        log_p=log_p,
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
    return states, counting & scenario.own_features.reacts(
        states
    ) if scenario.forgetful else counting


def _values(scenario: Scenario, states: StateBatch, counting: BoolArray) -> FloatArray:
    """What proposals look at where outcomes count, ``[M, D]``."""
    values = scenario.features(Given(scenario.asked[0])).values(states)
    return np.broadcast_to(values, (*counting.shape, values.shape[-1]))[counting]


def _likely(
    scenario: Scenario, outcomes: Outcomes, memory: Memory, count: int
) -> tuple[FloatArray, FloatArray]:
    """Log likelihood with a memory, and posterior mean of the obstacle's visibility, ``[N]``."""
    if memory.frailty == 0.0:
        logit = model_logit(scenario, outcomes, Given(memory))
        return under_logits(outcomes, logit, count=count), np.zeros(count)
    found = by_node(outcomes, memory, dt_s=scenario.problem.simulator.dt_s, count=count)
    return found.log_likelihood, found.mean


def _log_q(scenario: Scenario, outcomes: Outcomes, drawing: Drawing, count: int) -> FloatArray:
    """Log likelihood of N rollouts' outcomes under a fitted proposal, ``[N]``."""
    under_pem = model_logit(scenario, outcomes, drawing.around)
    raised = shift(outcomes.basis, drawing.coefficients)
    logit = defended(under_pem - raised, under_pem, share=scenario.defensive)
    if scenario.ignores(drawing.around):
        logit = np.where(outcomes.matters, logit, under_pem)
    return under_logits(outcomes, logit, count=count)
