"""Rollouts that serve many memories: what was drawn, from which proposals, how likely."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray, log_sum_exp
from pemviz.pem.models.memory import Memory
from pemviz.proposals.defensive_share import defended
from pemviz.proposals.exploration import ExplorationFamily
from pemviz.proposals.offset_logistic import PolynomialBasis, shift
from pemviz.sampling.bursts.likelihood import (
    Outcomes,
    by_node,
    under_logits,
)
from pemviz.sampling.bursts.scenario import Drawing, Given, Scenario
from pemviz.sampling.mixture.balance_heuristic import Decisions, Pool, balance_weights
from pemviz.sampling.rollouts.draw import replay
from pemviz.simulators.absorbing import VIOLATED
from pemviz.types import LAST_OUTCOME, RolloutBatch, ScoredRollouts, StateBatch

DEGREE = 3


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
