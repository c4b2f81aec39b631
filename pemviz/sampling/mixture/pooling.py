"""A stage's rollouts join the pool: how likely each is under every proposal, old and new."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, row_sums
from pemviz.config import LostName
from pemviz.proposals import offset_logistic as logistic
from pemviz.proposals.exploration import ExplorationFamily, LatentFamily
from pemviz.proposals.latent_moves import LatentDecisions, LatentMeans, even_logit
from pemviz.proposals.offset_logistic import Monomials, PolynomialBasis, StateFeatures
from pemviz.sampling.mixture import balance_heuristic as balance
from pemviz.sampling.mixture.balance_heuristic import (
    Decisions,
    FailingWeights,
    FittedMoves,
    Planned,
    Pool,
    Rule,
    Verdict,
)
from pemviz.sampling.mixture.plain import PlainRollouts
from pemviz.sampling.mixture.stages import Joining
from pemviz.sampling.problem import ScoredRule, judged
from pemviz.types import VIOLATED, RolloutBatch, ScoredRollouts, StateBatch

DEGREE, LOWER_DEGREE = 3, 2
"""Of monomials; the lower one where those of the other would be more than ``MOST_MONOMIALS``."""
MOST_MONOMIALS = 100
"""As many as a stage has rollouts by default. A fit with more of them follows the chains of errors
that it has met, and draws others that are as likely hundreds of times too seldom."""
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
        conjuncts: Of each rule that has some.
        lost: What a rollout counts as that could not be simulated to its end.
    """

    features: StateFeatures
    basis: PolynomialBasis
    defensive: float
    turns: int = 1
    starts: int = 0
    rules: tuple[str, ...] = ()
    many: bool = False
    conjuncts: Mapping[Rule, Sequence[ScoredRule]] = field(
        default_factory=dict[Rule, Sequence[ScoredRule]]
    )
    lost: LostName = "end"

    @property
    def under(self) -> tuple[Rule, ...]:
        """All rules together, and each."""
        return (None, *self.rules)


def first_basis(scored: ScoredRollouts, features: StateFeatures) -> PolynomialBasis:
    """Standardised by the decisions of the first stage."""
    states = scored.rollouts.decision_states()
    shape = scored.rollouts.detected.shape
    acts = logistic.acting(features, states, shape, violated=VIOLATED)
    values = features.values(states)
    values = np.broadcast_to(values, (*acts.shape, values.shape[-1]))[acts]
    basis = PolynomialBasis.standardised_by(values, degree=DEGREE)
    many = len(basis.exponents) > MOST_MONOMIALS
    return replace(basis, degree=LOWER_DEGREE) if many else basis


def extended(
    pool: Pool | None,
    joining: Joining,
    *,
    component: IntArray,
    new: Sequence[tuple[FittedMoves, FloatArray]],
    terms: Terms,
    last: bool = False,
    planned: Planned | None = None,
) -> Pool:
    """The pool with more rollouts.

    Args:
        pool: What was sampled before, or ``None``.
        joining: More rollouts.
        component: Index of each one's proposal in the extended list, ``[n]``, those among them that
            do not join.
        new: Proposals that the pool does not know yet, each with by how much it overstates the log
            likelihood of the pool's rollouts, which it was fitted to, ``[N]``.
        terms: What likelihoods are taken with.
        last: Nothing is fitted to these rollouts, so that their decisions need not be kept.
        planned: Of a large final batch, of which no more is kept than an average needs: weights of
            those that violate.
    """
    if last:
        terms = replace(terms, conjuncts={})
    moves = [each for each, _ in new]
    known = pool.proposals if pool else (error_model(joining.scored.rollouts, terms),)
    proposals = (*known, *moves)
    if pool is not None and planned is not None:
        fresh = _failing_of(joining.scored, component, proposals, terms, planned, pool.count)
    else:
        own = component if joining.row is None else component[joining.row]
        fresh = replace(
            pool_of(joining.scored, own, proposals, terms),
            component=component,
            row=joining.row,
            log_stands_for=joining.log_stands_for,
        )
    if pool is None:
        return fresh
    if new:
        before = [pool.log_ratio, *pool.rule_log_ratio.values()]
        added = _of_fitted(pool.decisions, pool.latents, moves, terms, count=pool.count)
        flattered = np.stack([optimism for _, optimism in new], axis=1)
        ratios = [
            np.hstack([known, each - flattered]) for known, each in zip(before, added, strict=True)
        ]
        by_rule = dict(zip(terms.rules, ratios[1:], strict=True))
        pool = replace(
            pool,
            log_ratio=ratios[0],
            rule_log_ratio=by_rule,
            lowered=_with_lowered(pool, flattered),
        )
    return _joined(pool, fresh, last=last)


def _with_lowered(pool: Pool, flattered: FloatArray) -> AnyArray | None:
    """Where latents are moved, corrections are not of first order (``leave_one_out_loss``)."""
    if pool.latents is not None:
        return None
    before = np.zeros(pool.log_ratio.shape) if pool.lowered is None else pool.lowered
    return np.hstack([before, flattered]).astype(np.float32)


def with_plain(plain: PlainRollouts, terms: Terms) -> Pool:
    """The pool of plain rollouts alone, of which those that violate, or are lost, are known."""
    return extended(
        None,
        Joining(plain.chosen, plain.row),
        component=np.full(plain.count, balance.PLAIN, dtype=np.int64),
        new=(),
        terms=terms,
    )


def pool_of(
    scored: ScoredRollouts, component: IntArray, proposals: Sequence[FittedMoves], terms: Terms
) -> Pool:
    """The pool of ``scored`` alone."""
    rollouts, features, basis = scored.rollouts, terms.features, terms.basis
    states = rollouts.decision_states()
    acts = logistic.acting(features, states, rollouts.detected.shape, violated=VIOLATED)
    broken = balance.broken_at(states.memory, terms.rules)
    values = features.values(states)
    values = np.broadcast_to(values, (*acts.shape, basis.mean.size))[acts]
    decisions = Decisions(
        rollout=np.nonzero(acts)[0].astype(np.int64),
        basis=Monomials(values, basis) if terms.many else basis.evaluate(values),
        missed=~rollouts.detected[acts],
        offset=-rollouts.pem_logit[acts],
        step=np.nonzero(acts)[1].astype(np.int64),
        broken=None if broken is None else broken[acts],
    )
    by_exploration = _by_exploration(rollouts, acts, broken, terms)
    latents = None
    if rollouts.latents is not None and (terms.starts or rollouts.latents.noise.shape[2]):
        latents, moved = _latents_of(rollouts, terms)
        by_exploration = [a + b for a, b in zip(by_exploration, moved, strict=True)]
    by_fitted = _of_fitted(decisions, latents, proposals, terms, count=rollouts.count)
    ratios = [
        np.hstack([exploration[:, None], fitted])
        for exploration, fitted in zip(by_exploration, by_fitted, strict=True)
    ]
    return Pool(
        decisions=decisions,
        component=component,
        proposals=tuple(proposals),
        log_ratio=ratios[0],
        robustness=scored.robustness,
        violated=scored.violated,
        log_p=row_sums(rollouts.log_p),
        rule_robustness=scored.rule_robustness,
        broken=scored.broken,
        rule_log_ratio=dict(zip(terms.rules, ratios[1:], strict=True)),
        conjuncts={
            rule: tuple(Verdict(*judged(one, rollouts, lost=terms.lost)) for one in some)
            for rule, some in terms.conjuncts.items()
        },
        latents=latents,
        start=_starts(rollouts, terms),
        steps=acts.shape[1],
    )


def _failing_of(  # noqa: PLR0917  as pool_of takes them
    scored: ScoredRollouts,
    component: IntArray,
    proposals: Sequence[FittedMoves],
    terms: Terms,
    planned: Planned,
    first: int,
) -> Pool:
    """The same of the violating rollouts alone, a few at a time; the others count.

    Their indices count from ``first``.
    """
    rows = np.flatnonzero(scored.violated).astype(np.int64)
    edges = np.linspace(0, rows.size, -(-rows.size // FAILING_AT_ONCE) + 1).astype(int)
    some = [rows[slice(*pair)] for pair in itertools.pairwise(edges.tolist())] or [rows]
    log_p, failing = np.full(component.size, np.nan), list[FailingWeights]()
    for few in some:
        part = pool_of(scored.take(few), component[few], proposals, terms)
        log_p[few] = part.log_p
        by_rule: dict[Rule, FloatArray] = {None: part.log_ratio, **part.rule_log_ratio}
        failing.append(FailingWeights.of(first + few, by_rule, planned))
    return replace(
        pool_of(scored.take(slice(0)), component[:0], proposals, terms),
        component=component,
        robustness=scored.robustness,
        violated=scored.violated,
        log_p=log_p,
        rule_robustness=scored.rule_robustness,
        broken=scored.broken,
        start=_starts(scored.rollouts, terms),
        failing=tuple(failing),
    )


def _starts(rollouts: RolloutBatch, terms: Terms) -> FloatArray | None:
    """Latents at the start that proposals move, ``[n, S]``."""
    latents = rollouts.latents
    return None if latents is None or not terms.starts else latents.start[:, : terms.starts]


def error_model(rollouts: RolloutBatch, terms: Terms) -> FittedMoves:
    """The proposal that moves nothing."""
    means, latents = None, rollouts.latents
    if latents is not None and (terms.starts or latents.noise.shape[2]):
        means = LatentMeans.unmoved(
            start=terms.starts,
            noise=latents.noise.shape[2],
            basis=len(terms.basis.with_outcome().exponents),
        )
    return FittedMoves(np.zeros(len(terms.basis.exponents)), means)


def _by_exploration(
    rollouts: RolloutBatch, acts: BoolArray, broken: BoolArray | None, terms: Terms
) -> list[FloatArray]:
    """Log of the exploration proposals' likelihood over the model's, ``[n]`` under each rule."""
    family = ExplorationFamily.over(acts.shape[1], turns=terms.turns)
    known: dict[bytes, FloatArray] = {}
    found: list[FloatArray] = []
    for within in _until_each(acts, broken, terms):
        key = np.packbits(within).tobytes()
        if key not in known:
            known[key] = family.log_ratio(rollouts, within)
        found.append(known[key])
    return found


def _latents_of(
    rollouts: RolloutBatch, terms: Terms
) -> tuple[LatentDecisions, Sequence[FloatArray]]:
    """Latents, and log of the exploration proposals' density over the model's under each rule."""
    latents, turns = rollouts.latents, terms.turns
    assert latents is not None  # noqa: S101  they are taken of rollouts that have some
    count, steps = rollouts.detected.shape
    columns = slice(turns - 1, steps, turns)
    states = StateBatch(
        step=np.arange(steps, dtype=np.int64)[None, columns],
        signals={name: values[:, columns] for name, values in rollouts.signals.items()},
        memory={name: values[:, columns] for name, values in rollouts.memory.items()},
    )
    over = states.memory.get(VIOLATED, np.zeros((count, steps // turns), dtype=np.bool_))
    start, noise = latents.start[:, : terms.starts], latents.noise.shape[2]
    family = LatentFamily.over(over.shape[1], start=terms.starts, noise=noise)
    acts = ~over if noise else np.zeros_like(over)
    broken = balance.broken_at(states.memory, terms.rules)
    values = logistic.noise_features(terms.features, states, rollouts.detected[:, columns])[acts]
    own = terms.basis.with_outcome()
    rows, step = np.nonzero(acts)
    decisions = LatentDecisions(
        start=start,
        rollout=rows.astype(np.int64),
        monomials=Monomials(values, own) if terms.many else own.evaluate(values),
        noise=latents.noise[acts],
        even=even_logit(step, steps=acts.shape[1]),
        broken=None if broken is None else broken[acts],
    )
    return decisions, [
        family.log_ratio(start, latents.noise, within)
        for within in _until_each(acts, broken, terms)
    ]


def _until_each(acts: BoolArray, broken: BoolArray | None, terms: Terms) -> list[BoolArray]:
    """Where outcomes or noise count under all rules together and under each, ``[N, T-1]``."""
    until = [balance.still_open(broken, terms.rules, rule) for rule in terms.under]
    return [acts if each is None else acts & each for each in until]


def _of_fitted(
    decisions: Decisions,
    latents: LatentDecisions | None,
    proposals: Sequence[FittedMoves],
    terms: Terms,
    *,
    count: int,
) -> Sequence[FloatArray]:
    return balance.log_ratios(
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
    latents, decisions, conjuncts = pool.latents, pool.decisions, pool.conjuncts
    if not last:
        conjuncts = {
            rule: tuple(map(_both, known, fresh.conjuncts[rule]))
            for rule, known in conjuncts.items()
        }
        if latents is not None and fresh.latents is not None:
            latents = latents.joined(fresh.latents)
        moved = replace(fresh.decisions, rollout=fresh.decisions.rollout + pool.count)
        decisions = Decisions.concatenate([decisions, moved])
    row = log_stands_for = None
    if pool.row is not None or fresh.row is not None:
        row = np.concatenate([pool.rows, fresh.rows + pool.sampled])
    if pool.log_stands_for is not None or fresh.log_stands_for is not None:
        stand_for = [(each.log_stands_for, each.count) for each in (pool, fresh)]
        log_stands_for = np.concatenate(
            [np.zeros(count) if own is None else own for own, count in stand_for]
        )
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
        lowered=None
        if pool.lowered is None
        else np.pad(pool.lowered, ((0, len(fresh.log_ratio)), (0, 0))),
        conjuncts=conjuncts,
        latents=latents,
        start=None
        if pool.start is None or fresh.start is None
        else np.concatenate([pool.start, fresh.start]),
        failing=(*pool.failing, *fresh.failing),
        row=row,
        log_stands_for=log_stands_for,
    )


def _appended(before: Mapping[str, AnyArray], after: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: np.concatenate([values, after[name]]) for name, values in before.items()}


def _both(before: Verdict, after: Verdict) -> Verdict:
    return Verdict(
        robustness=np.concatenate([before.robustness, after.robustness]),
        violated=np.concatenate([before.violated, after.violated]),
    )
