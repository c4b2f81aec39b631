"""Rollouts that serve every memory time: what was drawn, from which proposals, how likely."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray
from pemviz.proposals.defensive_share import defended
from pemviz.proposals.offset_logistic import PolynomialBasis, shift
from pemviz.proposals.pilots import PilotFamily
from pemviz.sampling.bursts.scenario import PILOTED_S, Drawing, Scenario
from pemviz.sampling.mixture.balance_heuristic import Decisions, Pool, balance_weights
from pemviz.simulators.latched import VIOLATED
from pemviz.types import RolloutBatch, ScoredRollouts, outcome_log_likelihood

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


@dataclass(frozen=True)
class Drawn:
    """N rollouts and K proposals, beside pilots.

    Attributes:
        outcomes: Of all rollouts.
        component: What each was drawn from, ``[N]``: 0 is the pilots' families, k the k-th
            proposal.
        log_q: Log likelihood under the pilots and under each proposal, ``[N, 1 + K]`` [nats].
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


def first_basis(scenario: Scenario, scored: ScoredRollouts) -> PolynomialBasis:
    """Monomials of the features, standardised by the first rollouts; constants keep spread 1."""
    states = scored.rollouts.decision_states()
    values = scenario.features(0.0).values(states)[_before_violation(scored.rollouts)]
    spread = np.std(values, axis=0)
    return PolynomialBasis(
        mean=np.mean(values, axis=0), spread=np.where(spread > 0.0, spread, 1.0), degree=DEGREE
    )


def described(
    scenario: Scenario, scored: ScoredRollouts, drawings: Sequence[Drawing], *, component: int
) -> Drawn:
    """Rollouts drawn from one component, with their likelihood under all."""
    assert scenario.basis is not None  # noqa: S101  chosen from the pilots' rollouts
    rollouts = scored.rollouts
    states, counting = rollouts.decision_states(), _before_violation(rollouts)
    salient = scenario.problem.simulator.salient(states.signals)
    own_logit, last = scenario.pem.logit(salient[..., :-1]), salient[..., -1]
    matters = np.broadcast_to(scenario.own_features.reacts(states), counting.shape)
    outcomes = Outcomes(
        rollout=np.nonzero(counting)[0].astype(np.int64),
        basis=scenario.basis.evaluate(scenario.features(0.0).values(states)[counting]),
        missed=~rollouts.detected[counting],
        last=last[counting],
        logit=own_logit[counting],
        matters=matters[counting],
    )
    by_family = [
        _summed(outcomes, model_logit(scenario, outcomes, tau_s), rollouts.count)
        + PilotFamily.over(scenario.steps).log_ratio(
            replace(rollouts, pem_logit=scenario.model(tau_s).after(own_logit, last)),
            counting & matters if scenario.features(tau_s).ignores else counting,
        )
        for tau_s in PILOTED_S
    ]
    by_pilots = np.asarray(logsumexp(by_family, axis=0)) - np.log(len(by_family))
    by_fits = [_log_q(scenario, outcomes, drawing, rollouts.count) for drawing in drawings]
    return Drawn(
        outcomes=outcomes,
        component=np.full(rollouts.count, component, dtype=np.int64),
        log_q=np.stack([by_pilots, *by_fits], axis=1),
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
        robustness=np.concatenate([before.robustness, fresh.robustness]),
        violated=np.concatenate([before.violated, fresh.violated]),
    )


def model_logit(scenario: Scenario, outcomes: Outcomes, tau_s: float) -> FloatArray:
    """Logit of 'detected' under the model with a memory time, ``[M]``."""
    return scenario.model(tau_s).after(outcomes.logit, outcomes.last)


def seen_at(scenario: Scenario, drawn: Drawn, tau_s: float) -> Pool:
    """The rollouts as draws for one memory time, with the decisions that its proposals make."""
    outcomes = drawn.outcomes
    logit = model_logit(scenario, outcomes, tau_s)
    log_p = _summed(outcomes, logit, drawn.count)
    decisions = Decisions(
        rollout=outcomes.rollout, basis=outcomes.basis, missed=outcomes.missed, offset=-logit
    )
    if scenario.features(tau_s).ignores:
        decisions = decisions.take(outcomes.matters)
    return Pool(
        decisions=decisions,
        component=drawn.component,
        coefficients=(),
        log_ratio=drawn.log_q - log_p[:, None],
        robustness=drawn.robustness,
        violated=drawn.violated,
        log_p=log_p,
    )


def log_weights(scenario: Scenario, drawn: Drawn, tau_s: float) -> FloatArray:
    """Of every rollout for a memory time, by the balance heuristic, ``[N]``."""
    log_p = _summed(drawn.outcomes, model_logit(scenario, drawn.outcomes, tau_s), drawn.count)
    return balance_weights(drawn.log_q - log_p[:, None], drawn.component)


def _before_violation(rollouts: RolloutBatch) -> BoolArray:
    """Which outcomes ``[N, T-1]`` a rollout has before it violates, if it knows of that."""
    shape = rollouts.detected.shape
    latch = rollouts.memory.get(VIOLATED)
    return np.ones(shape, dtype=np.bool_) if latch is None else ~latch[:, : shape[1]]


def _log_q(scenario: Scenario, outcomes: Outcomes, drawing: Drawing, count: int) -> FloatArray:
    """Log likelihood of N rollouts' outcomes under a fitted proposal, ``[N]``."""
    under_pem = model_logit(scenario, outcomes, drawing.tau_s)
    raised = shift(outcomes.basis, drawing.coefficients)
    logit = defended(under_pem - raised, under_pem, share=scenario.defensive)
    if scenario.features(drawing.tau_s).ignores:
        logit = np.where(outcomes.matters, logit, under_pem)
    return _summed(outcomes, logit, count)


def _summed(outcomes: Outcomes, logit: FloatArray, count: int) -> FloatArray:
    log_p = outcome_log_likelihood(logit, ~outcomes.missed)
    return np.bincount(outcomes.rollout, weights=log_p, minlength=count).astype(np.float64)
