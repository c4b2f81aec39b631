"""Rollouts that serve every memory time: what was drawn, from which proposals, how likely."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray
from pemviz.pem import Pem
from pemviz.pem.models.memory import Memory
from pemviz.proposals.defensive_share import defended, share_for
from pemviz.proposals.offset_logistic import (
    OffsetLogisticProposal,
    PolynomialBasis,
    StateFeatures,
    acting,
    shift,
)
from pemviz.sampling.memory import RememberingFeatures, RememberingPem
from pemviz.sampling.problem import Problem, sample
from pemviz.simulators.latched import VIOLATED
from pemviz.types import ScoredRollouts, StateBatch, outcome_log_likelihood

DEFENSIVE_STEPS = 2.0
DEGREE = 3
SHORT_RHO = 0.01
"""Below, what an outcome leaves behind is not worth changing one that the scenario ignores."""


@dataclass(frozen=True)
class Drawing:
    """A proposal: coefficients ``[B]``, or one constant ``[1]``, around a memory time's model."""

    tau_s: float
    coefficients: FloatArray


@dataclass(frozen=True)
class Scenario:
    """What rollouts are drawn on: the problem with memory and latch, and what is looked at."""

    problem: Problem
    pem: Pem
    features: RememberingFeatures
    own_features: StateFeatures
    basis: PolynomialBasis | None = None

    @property
    def defensive(self) -> float:
        """Share of the model in every outcome's probability."""
        return share_for(drawn_steps=DEFENSIVE_STEPS, steps=self.problem.simulator.states - 1)

    def model(self, tau_s: float) -> RememberingPem:
        """The error model with a memory time."""
        return RememberingPem(self.pem, Memory(tau_s=tau_s), self.problem.simulator.dt_s)

    def is_short(self, tau_s: float) -> bool:
        """Whether a memory time is so short that ignored outcomes are left to the model."""
        return self.model(tau_s).rho < SHORT_RHO

    def proposal(self, drawing: Drawing) -> OffsetLogisticProposal:
        """What rollouts are drawn from."""
        is_constant = drawing.coefficients.size == 1 or self.basis is None
        none = PolynomialBasis(mean=np.zeros(0), spread=np.zeros(0), degree=0)
        return OffsetLogisticProposal(
            features=_Seen(
                self.features,
                reacting=self.own_features if self.is_short(drawing.tau_s) else self.features,
                blind=is_constant,
            ),
            basis=none if is_constant or self.basis is None else self.basis,
            coefficients=drawing.coefficients,
            violated=VIOLATED,
            defensive=self.defensive,
        )


@dataclass(frozen=True)
class _Seen:
    """Features, or none for a constant proposal, where the ``reacting`` ones say they matter."""

    features: StateFeatures
    reacting: StateFeatures
    blind: bool

    def values(self, states: StateBatch) -> FloatArray:
        shape = next(iter(states.signals.values())).shape
        return np.zeros((*shape, 0)) if self.blind else self.features.values(states)

    def reacts(self, states: StateBatch) -> BoolArray:
        return self.reacting.reacts(states)


@dataclass(frozen=True)
class Outcomes(Batch):
    """Outcomes before a violation, in the order of rollouts.

    Attributes:
        rollout: Which rollout, ``[M]``.
        basis: ``[M, B]``.
        missed: ``[M]``.
        last: The outcome before: missed (-1), detected (1), none (0), ``[M]``.
        logit: Of 'detected' under the model of single outcomes, ``[M]``.
        near: Whether the scenario itself reacts, ``[M]``.
    """

    rollout: IntArray
    basis: FloatArray
    missed: BoolArray
    last: FloatArray
    logit: FloatArray
    near: BoolArray


@dataclass(frozen=True)
class Drawn:
    """N rollouts and K proposals.

    Attributes:
        outcomes: Of all rollouts.
        component: Which proposal each was drawn from, ``[N]``.
        log_q: Log likelihood under each proposal, ``[N, K]`` [nats].
        robustness: ``[N]``.
        violated: ``[N]``.
    """

    outcomes: Outcomes
    component: IntArray
    log_q: FloatArray
    robustness: FloatArray
    violated: BoolArray

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return int(self.violated.size)


def simulated(
    scenario: Scenario,
    drawings: Sequence[Drawing],
    counts: Sequence[int],
    seeds: np.random.SeedSequence,
) -> ScoredRollouts:
    """``counts`` rollouts from each of the drawings, in their order."""
    parts = [
        sample(
            replace(scenario.problem, pem=scenario.model(drawing.tau_s)),
            proposal=scenario.proposal(drawing),
            count=count,
            seeds=child,
        )
        for drawing, count, child in zip(drawings, counts, seeds.spawn(len(counts)), strict=True)
        if count
    ]
    return ScoredRollouts.concatenate(parts)


def _feature_values(scenario: Scenario, scored: ScoredRollouts) -> tuple[FloatArray, BoolArray]:
    """Features ``[M, D]`` of the states before a violation, and which those are ``[N, T-1]``."""
    states = scored.rollouts.decision_states()
    shape = scored.rollouts.detected.shape
    acts = acting(scenario.features, states, shape, violated=VIOLATED)
    return scenario.features.values(states)[acts], acts


def first_basis(scenario: Scenario, scored: ScoredRollouts) -> PolynomialBasis:
    """Monomials of the features, standardised by the first rollouts; constants keep spread 1."""
    values, _ = _feature_values(scenario, scored)
    spread = np.std(values, axis=0)
    return PolynomialBasis(
        mean=np.mean(values, axis=0), spread=np.where(spread > 0.0, spread, 1.0), degree=DEGREE
    )


def described(
    scenario: Scenario,
    scored: ScoredRollouts,
    drawings: Sequence[Drawing],
    counts: Sequence[int],
) -> Drawn:
    """Rollouts of which ``counts`` came from each of the drawings, in their order."""
    assert scenario.basis is not None  # noqa: S101  chosen from the first rollouts
    rollouts = scored.rollouts
    states = rollouts.decision_states()
    values, acts = _feature_values(scenario, scored)
    salient = scenario.problem.simulator.salient(states.signals)[acts]
    outcomes = Outcomes(
        rollout=np.nonzero(acts)[0].astype(np.int64),
        basis=scenario.basis.evaluate(values),
        missed=~rollouts.detected[acts],
        last=salient[:, -1],
        logit=scenario.pem.logit(salient[:, :-1]),
        near=np.broadcast_to(scenario.own_features.reacts(states), acts.shape)[acts],
    )
    log_q = [_log_q(scenario, outcomes, drawing, rollouts.count) for drawing in drawings]
    return Drawn(
        outcomes=outcomes,
        component=np.repeat(np.arange(len(counts)), counts),
        log_q=np.stack(log_q, axis=1),
        robustness=scored.robustness,
        violated=scored.violated,
    )


def with_drawing(scenario: Scenario, drawn: Drawn, drawing: Drawing) -> Drawn:
    """The rollouts with their likelihood under one more proposal."""
    log_q = _log_q(scenario, drawn.outcomes, drawing, drawn.count)
    return replace(drawn, log_q=np.column_stack([drawn.log_q, log_q]))


def joined(before: Drawn, fresh: Drawn) -> Drawn:
    """Both, of the same proposals."""
    shifted = replace(fresh.outcomes, rollout=fresh.outcomes.rollout + before.count)
    return Drawn(
        outcomes=Outcomes.concatenate([before.outcomes, shifted]),
        component=np.concatenate([before.component, fresh.component]),
        log_q=np.concatenate([before.log_q, fresh.log_q]),
        robustness=np.concatenate([before.robustness, fresh.robustness]),
        violated=np.concatenate([before.violated, fresh.violated]),
    )


def model_logit(scenario: Scenario, outcomes: Outcomes, tau_s: float) -> FloatArray:
    """Logit of 'detected' under the model with a memory time, ``[M]``."""
    return scenario.model(tau_s).after(outcomes.logit, outcomes.last)


def _log_q(scenario: Scenario, outcomes: Outcomes, drawing: Drawing, count: int) -> FloatArray:
    """Log likelihood of N rollouts' outcomes under a proposal, ``[N]``."""
    under_pem = model_logit(scenario, outcomes, drawing.tau_s)
    coefficients = drawing.coefficients
    is_constant = coefficients.size == 1
    raised = coefficients[0] if is_constant else shift(outcomes.basis, coefficients)
    logit = defended(under_pem - raised, under_pem, share=scenario.defensive)
    if scenario.is_short(drawing.tau_s):
        logit = np.where(outcomes.near, logit, under_pem)
    return _log_likelihood(outcomes, logit, count)


def _log_likelihood(outcomes: Outcomes, logit: FloatArray, count: int) -> FloatArray:
    log_p = outcome_log_likelihood(logit, ~outcomes.missed)
    return np.bincount(outcomes.rollout, weights=log_p, minlength=count).astype(np.float64)


def log_weights(scenario: Scenario, drawn: Drawn, tau_s: float) -> FloatArray:
    """Of every rollout for a memory time, ``[N]``."""
    logit = model_logit(scenario, drawn.outcomes, tau_s)
    log_p = _log_likelihood(drawn.outcomes, logit, drawn.count)
    taken = np.bincount(drawn.component, minlength=drawn.log_q.shape[1])
    with np.errstate(divide="ignore"):  # a proposal that nothing was drawn from does not count
        log_share = np.log(taken / drawn.count)
    return log_p - np.asarray(logsumexp(drawn.log_q + log_share, axis=1))
