"""A stage's rollouts join the pool: how likely each is under every proposal, old and new."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, row_sums
from pemviz.proposals.latent_means import LatentDecisions
from pemviz.proposals.offset_logistic import PolynomialBasis, StateFeatures, acting
from pemviz.proposals.pilots import PilotFamily
from pemviz.sampling.mixture.aims import Rule, broken_at, still_open
from pemviz.sampling.mixture.balance_heuristic import (
    Decisions,
    FittedMoves,
    Pool,
    decisions_of,
    log_ratios,
)
from pemviz.sampling.mixture.latents import fresh_latents
from pemviz.simulators.latched import VIOLATED
from pemviz.types import RolloutBatch, ScoredRollouts

FAILING_AT_ONCE = 2_000
"""Of a large final batch's violations: each decision's monomials take as much as a rollout's steps
otherwise do."""


@dataclass(frozen=True)
class Terms:
    """What likelihoods of a scenario's rollouts are taken with.

    Attributes:
        features: What proposals look at.
        basis: Its monomials.
        defensive: Share of the error model in every outcome's probability.
        turns: Outcomes of a step.
        starts: Latents at the start that proposals move.
        rules: Names, where there are several.
        many: Whether the rollouts to learn from are so many that their monomials are not kept.
    """

    features: StateFeatures
    basis: PolynomialBasis
    defensive: float
    turns: int = 1
    starts: int = 0
    rules: tuple[str, ...] = ()
    many: bool = False

    @property
    def under(self) -> tuple[Rule, ...]:
        """All rules together, and each."""
        return (None, *self.rules)


def extended(
    pool: Pool | None,
    scored: ScoredRollouts,
    *,
    drawn_from: IntArray,
    new: Sequence[FittedMoves],
    optimism: Sequence[FloatArray],
    terms: Terms,
    last: bool = False,
    large: bool = False,
) -> Pool:
    """The pool with more rollouts.

    Args:
        pool: What was drawn before, or ``None``.
        scored: n more rollouts.
        drawn_from: Index of each one's proposal in the extended list, ``[n]``.
        new: Proposals that the pool does not know yet.
        optimism: By how much each new proposal overstates the log likelihood of the pool's
            rollouts, which it was fitted to, ``[N]``.
        terms: What likelihoods are taken with.
        last: Nothing is fitted to these rollouts, so that their decisions need not be kept.
        large: Of these no more is kept than an average needs: the ratios of those that violate.
    """
    proposals = (*(pool.proposals if pool else ()), *new)
    if pool is None:
        return _pool_of(scored, drawn_from, proposals, terms)
    fresh = (_failing_of if large else _pool_of)(scored, drawn_from, proposals, terms)
    return _joined(_under_new(pool, new, optimism, terms), fresh, last=last)


def _pool_of(
    scored: ScoredRollouts,
    drawn_from: IntArray,
    proposals: tuple[FittedMoves, ...],
    terms: Terms,
) -> Pool:
    """The pool of ``scored`` alone."""
    decisions, latents, by_pilots = _fresh(scored.rollouts, terms)
    by_fitted = _of_fitted(decisions, latents, proposals, terms, count=scored.rollouts.count)
    after = [
        np.hstack([pilots[:, None], fitted])
        for pilots, fitted in zip(by_pilots, by_fitted, strict=True)
    ]
    return Pool(
        decisions=decisions,
        component=drawn_from,
        proposals=proposals,
        log_ratio=after[0],
        robustness=scored.robustness,
        violated=scored.violated,
        log_p=row_sums(scored.rollouts.log_p),
        rule_robustness=scored.rule_robustness,
        broken=scored.broken,
        rule_log_ratio=dict(zip(terms.rules, after[1:], strict=True)),
        latents=latents,
    )


def _failing_of(
    scored: ScoredRollouts,
    drawn_from: IntArray,
    proposals: tuple[FittedMoves, ...],
    terms: Terms,
) -> Pool:
    """The same of the violating rollouts alone, a few at a time; the others count."""
    rows = np.flatnonzero(scored.violated).astype(np.int64)
    edges = np.linspace(0, rows.size, -(-rows.size // FAILING_AT_ONCE) + 1).astype(int)
    some = [rows[slice(*pair)] for pair in itertools.pairwise(edges.tolist())] or [rows]
    parts = [_pool_of(scored.take(few), drawn_from[few], proposals, terms) for few in some]
    log_p = np.full(drawn_from.size, np.nan)
    log_p[rows] = np.concatenate([part.log_p for part in parts])
    ratios = [[part.rule_log_ratio[rule] for part in parts] for rule in terms.rules]
    return replace(
        parts[0],
        component=drawn_from,
        log_ratio=np.concatenate([part.log_ratio for part in parts]),
        robustness=scored.robustness,
        violated=scored.violated,
        log_p=log_p,
        rule_robustness=scored.rule_robustness,
        broken=scored.broken,
        rule_log_ratio=dict(zip(terms.rules, map(np.concatenate, ratios), strict=True)),
        held=rows,
    )


def _under_new(
    pool: Pool, new: Sequence[FittedMoves], optimism: Sequence[FloatArray], terms: Terms
) -> Pool:
    """The pool's rollouts under the proposals that were fitted to them, too."""
    if not new:
        return pool
    before = [pool.log_ratio, *pool.rule_log_ratio.values()]
    added = _of_fitted(pool.decisions, pool.latents, new, terms, count=pool.count)
    flattered = np.stack(optimism, axis=1)
    ratios = [
        np.hstack([known, each - flattered]) for known, each in zip(before, added, strict=True)
    ]
    by_rule = dict(zip(terms.rules, ratios[1:], strict=True))
    return replace(pool, log_ratio=ratios[0], rule_log_ratio=by_rule)


def _fresh(
    rollouts: RolloutBatch, terms: Terms
) -> tuple[Decisions, LatentDecisions | None, Sequence[FloatArray]]:
    """Decisions, latents, and log of the pilots' likelihood over the model's under each rule."""
    states = rollouts.decision_states()
    acts = acting(terms.features, states, rollouts.detected.shape, violated=VIOLATED)
    broken = broken_at(states.memory, terms.rules)
    decisions = decisions_of(
        rollouts,
        acts,
        features=terms.features,
        basis=terms.basis,
        broken=broken,
        many=terms.many,
    )
    by_pilots = _by_pilots(rollouts, acts, broken, terms)
    latents = fresh_latents(
        rollouts,
        features=terms.features,
        basis=terms.basis,
        turns=terms.turns,
        starts=terms.starts,
        rules=terms.rules,
    )
    if latents is None:
        return decisions, None, by_pilots
    both = [first + second for first, second in zip(by_pilots, latents.by_pilots, strict=True)]
    return decisions, latents.decisions, both


def _by_pilots(
    rollouts: RolloutBatch, acts: BoolArray, broken: BoolArray | None, terms: Terms
) -> Sequence[FloatArray]:
    """Log of the pilots' likelihood over the model's, ``[n]`` under each rule."""
    family = PilotFamily.over(acts.shape[1], turns=terms.turns)
    known: dict[bytes, FloatArray] = {}
    found: list[FloatArray] = []
    for rule in terms.under:
        until = still_open(broken, terms.rules, rule)
        within = acts if until is None else acts & until
        key = np.packbits(within).tobytes()
        if key not in known:
            known[key] = family.log_ratio(rollouts, within)
        found.append(known[key])
    return found


def _of_fitted(
    decisions: Decisions,
    latents: LatentDecisions | None,
    proposals: Sequence[FittedMoves],
    terms: Terms,
    *,
    count: int,
) -> Sequence[FloatArray]:
    return log_ratios(
        decisions,
        proposals,
        count=count,
        defensive=terms.defensive,
        rules=terms.rules,
        under=terms.under,
        latents=latents,
    )


def _joined(pool: Pool, fresh: Pool, *, last: bool) -> Pool:
    """The rollouts of both."""
    latents = pool.latents
    if latents is not None and fresh.latents is not None and not last:
        latents = latents.joined(fresh.latents)
    decisions, held = pool.decisions, pool.held
    if not last:
        moved = replace(fresh.decisions, rollout=fresh.decisions.rollout + pool.count)
        decisions = Decisions.concatenate([decisions, moved])
    if fresh.held is not None:
        before = np.arange(pool.count, dtype=np.int64) if held is None else held
        held = np.concatenate([before, fresh.held + pool.count])
    return replace(
        fresh,
        decisions=decisions,
        component=np.concatenate([pool.component, fresh.component]),
        log_ratio=np.vstack([pool.log_ratio, fresh.log_ratio]),
        robustness=np.concatenate([pool.robustness, fresh.robustness]),
        violated=np.concatenate([pool.violated, fresh.violated]),
        log_p=np.concatenate([pool.log_p, fresh.log_p]),
        rule_robustness=_appended(pool.rule_robustness, fresh.rule_robustness),
        broken=_appended(pool.broken, fresh.broken),
        rule_log_ratio=_appended(pool.rule_log_ratio, fresh.rule_log_ratio),
        latents=latents,
        held=held,
    )


def _appended(before: Mapping[str, AnyArray], after: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: np.concatenate([values, after[name]]) for name, values in before.items()}
