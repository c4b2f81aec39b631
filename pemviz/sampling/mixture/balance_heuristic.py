"""All rollouts of all stages, weighted as draws from the mixture of all proposals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import logsumexp

from pemviz.arrays import AnyArray, Batch, BoolArray, FloatArray, IntArray, row_sums
from pemviz.proposals.defensive_share import defended
from pemviz.proposals.latent_means import LatentDecisions, LatentMeans
from pemviz.proposals.offset_logistic import (
    PolynomialBasis,
    StateFeatures,
    acting,
    shift,
)
from pemviz.proposals.pilots import PilotFamily
from pemviz.sampling.mixture.latents import FreshLatents, latent_ratios
from pemviz.simulators.latched import VIOLATED
from pemviz.types import RolloutBatch, ScoredRollouts


@dataclass(frozen=True)
class Decisions(Batch):
    """The steps of N rollouts at which a proposal may differ from the error model.

    Attributes:
        rollout: Index of the rollout, ascending, ``[M]``.
        basis: ``[M, B]``.
        missed: ``[M]``.
        offset: The error model's logit of a miss, ``[M]``.
    """

    rollout: IntArray
    basis: FloatArray
    missed: BoolArray
    offset: FloatArray


@dataclass(frozen=True)
class Pool:
    """Everything drawn so far.

    Attributes:
        decisions: Of all rollouts but the final ones.
        component: What each rollout was drawn from, ``[N]``: 0 is the pilots' family, k the
            k-th fitted proposal.
        coefficients: Of each fitted proposal, K arrays ``[B]``.
        log_ratio: Log q_k / p of each rollout under the family and each proposal, ``[N, 1 + K]``.
        robustness: ``[N]``.
        violated: ``[N]``.
        log_p: Log likelihood under the error model, ``[N]``.
        rule_robustness: ``[N]`` of each rule by name, where there are rules.
        broken: ``[N]`` likewise.
        latents: Of all rollouts but the final ones, where there are any.
        means: How each fitted proposal moves them.
    """

    decisions: Decisions
    component: IntArray
    coefficients: tuple[FloatArray, ...]
    log_ratio: FloatArray
    robustness: FloatArray
    violated: BoolArray
    log_p: FloatArray
    rule_robustness: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    broken: Mapping[str, BoolArray] = field(default_factory=dict[str, BoolArray])
    latents: LatentDecisions | None = None
    means: tuple[LatentMeans, ...] = ()

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return int(self.violated.size)

    @property
    def noisy(self) -> bool:
        """Whether steps have noise."""
        return self.latents is not None and self.latents.noise.shape[1] > 0

    def under_rule(self, rule: str) -> "Pool":
        """The same rollouts with the robustness and the verdict of one rule."""
        return replace(self, robustness=self.rule_robustness[rule], violated=self.broken[rule])

    def each_rule(self) -> "Sequence[Pool]":
        """The pool under every rule; itself where there is but the specification."""
        return [self.under_rule(rule) for rule in self.broken] or [self]

    @property
    def log_weight(self) -> FloatArray:
        """Log weights ``[N]`` by the balance heuristic: log p / sum_k (n_k / N) q_k.

        Veach & Guibas 1995; every rollout counts as a draw from the mixture.
        """
        return balance_weights(self.log_ratio, self.component)


def balance_weights(log_ratio: FloatArray, component: IntArray) -> FloatArray:
    """-log sum_k (n_k / N) exp(log_ratio_k) for ratios ``[N, K]`` and components ``[N]``."""
    return -np.asarray(logsumexp(log_ratio + log_shares(log_ratio, component), axis=1))


def log_shares(log_ratio: FloatArray, component: IntArray) -> FloatArray:
    """Log of the share n_k / N of rollouts drawn from each of K components, ``[K]``."""
    counts = np.bincount(component, minlength=log_ratio.shape[1])
    with np.errstate(divide="ignore"):  # a proposal that nothing was drawn from does not count
        return np.log(counts / component.size)


def decisions_of(
    rollouts: RolloutBatch, acts: BoolArray, *, features: StateFeatures, basis: PolynomialBasis
) -> Decisions:
    """The decisions of N rollouts, which are made where ``acts [N, T-1]``."""
    values = features.values(rollouts.decision_states())
    values = np.broadcast_to(values, (*acts.shape, basis.mean.size))[acts]
    return Decisions(
        rollout=np.nonzero(acts)[0].astype(np.int64),
        basis=basis.evaluate(values),
        missed=~rollouts.detected[acts],
        offset=-rollouts.pem_logit[acts],
    )


def _acts(rollouts: RolloutBatch, features: StateFeatures) -> BoolArray:
    states = rollouts.decision_states()
    return acting(features, states, rollouts.detected.shape, violated=VIOLATED)


def log_ratios(
    decisions: Decisions, coefficients: Sequence[FloatArray], *, count: int, defensive: float
) -> FloatArray:
    """Log q_k / p ``[N, K]`` of N rollouts under fitted proposals."""
    columns = [_log_ratio(decisions, chosen, count, defensive) for chosen in coefficients]
    return np.stack(columns, axis=1) if columns else np.zeros((count, 0))


def _log_ratio(
    decisions: Decisions, coefficients: FloatArray, count: int, defensive: float
) -> FloatArray:
    raised = decisions.offset + shift(decisions.basis, coefficients)
    raised = defended(raised, decisions.offset, share=defensive)
    sign = np.where(decisions.missed, -1.0, 1.0)
    step = np.logaddexp(0.0, sign * decisions.offset) - np.logaddexp(0.0, sign * raised)
    return np.bincount(decisions.rollout, weights=step, minlength=count).astype(np.float64)


def extended(
    pool: Pool | None,
    scored: ScoredRollouts,
    *,
    drawn_from: IntArray,
    new: Sequence[FloatArray],
    optimism: Sequence[FloatArray],
    pilots: PilotFamily,
    defensive: float,
    features: StateFeatures,
    basis: PolynomialBasis,
    latents: FreshLatents | None = None,
    last: bool = False,
) -> Pool:
    """The pool with more rollouts.

    Args:
        pool: What was drawn before, or ``None``.
        scored: n more rollouts.
        drawn_from: Index of each one's proposal in the extended list, ``[n]``.
        new: Coefficients of proposals that the pool does not know yet.
        optimism: By how much each new proposal overstates the log likelihood of the pool's
            rollouts, which it was fitted to, ``[N]``.
        pilots: The family that component 0 stands for.
        defensive: Share of the error model in every outcome's probability.
        features: What proposals look at.
        basis: Its monomials.
        latents: Of the rollouts, where there are any.
        last: Nothing is fitted to these rollouts, so that their decisions need not be kept.
    """
    acts = _acts(scored.rollouts, features)
    fresh = decisions_of(scored.rollouts, acts, features=features, basis=basis)
    count = scored.rollouts.count
    log_p = row_sums(scored.rollouts.log_p)
    coefficients = (*(pool.coefficients if pool else ()), *new)
    fitted = log_ratios(fresh, coefficients, count=count, defensive=defensive)
    after = np.hstack([pilots.log_ratio(scored.rollouts, acts)[:, None], fitted])
    means = (*(pool.means if pool else ()), *(latents.means if latents else ()))
    if latents is not None:
        of_latents = latent_ratios(latents.decisions, means)
        after = after + np.hstack([latents.by_pilots[:, None], of_latents])
    if pool is None:
        return Pool(
            decisions=fresh,
            component=drawn_from,
            coefficients=coefficients,
            log_ratio=after,
            robustness=scored.robustness,
            violated=scored.violated,
            log_p=log_p,
            rule_robustness=scored.rule_robustness,
            broken=scored.broken,
            latents=None if latents is None else latents.decisions,
            means=means,
        )
    before, known = pool.log_ratio, pool.latents
    if new:
        added = log_ratios(pool.decisions, new, count=pool.count, defensive=defensive)
        if known is not None and latents is not None:
            added = added + latent_ratios(known, latents.means)
        before = np.hstack([before, added - np.stack(optimism, axis=1)])
    return Pool(
        decisions=pool.decisions if last else _joined(pool.decisions, fresh, first=pool.count),
        component=np.concatenate([pool.component, drawn_from]),
        coefficients=coefficients,
        log_ratio=np.vstack([before, after]),
        robustness=np.concatenate([pool.robustness, scored.robustness]),
        violated=np.concatenate([pool.violated, scored.violated]),
        log_p=np.concatenate([pool.log_p, log_p]),
        rule_robustness=_appended(pool.rule_robustness, scored.rule_robustness),
        broken=_appended(pool.broken, scored.broken),
        latents=known if last else _with_latents(known, latents),
        means=means,
    )


def _appended(before: Mapping[str, AnyArray], after: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: np.concatenate([values, after[name]]) for name, values in before.items()}


def _with_latents(
    known: LatentDecisions | None, fresh: FreshLatents | None
) -> LatentDecisions | None:
    return known if known is None or fresh is None else known.joined(fresh.decisions)


def _joined(before: Decisions, fresh: Decisions, *, first: int) -> Decisions:
    return Decisions.concatenate([before, replace(fresh, rollout=fresh.rollout + first)])
