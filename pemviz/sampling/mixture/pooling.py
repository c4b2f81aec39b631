"""A stage's rollouts join the pool: how likely each is under every proposal, old and new."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, row_sums
from pemviz.proposals.exploration import ExplorationFamily, LatentFamily
from pemviz.proposals.latent_moves import LatentDecisions, even_logit
from pemviz.proposals.offset_logistic import (
    Monomials,
    PolynomialBasis,
    StateFeatures,
    acting,
    noise_basis,
    noise_features,
)
from pemviz.sampling.mixture.balance_heuristic import (
    Decisions,
    FailingWeights,
    FittedMoves,
    Planned,
    Pool,
    Rule,
    broken_at,
    decisions_of,
    log_ratios,
    still_open,
)
from pemviz.sampling.mixture.stages import Joining
from pemviz.simulators.absorbing import VIOLATED
from pemviz.types import RolloutBatch, ScoredRollouts, StateBatch

DEGREE = 3
"""Of monomials."""
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


def first_basis(scored: ScoredRollouts, features: StateFeatures) -> PolynomialBasis:
    """Standardised by the decisions of the first stage; a constant feature keeps spread 1."""
    states = scored.rollouts.decision_states()
    acts = acting(features, states, scored.rollouts.detected.shape, violated=VIOLATED)
    values = features.values(states)
    values = np.broadcast_to(values, (*acts.shape, values.shape[-1]))[acts]
    if values.shape[0] == 0:
        return PolynomialBasis(np.zeros(values.shape[1]), np.ones(values.shape[1]), DEGREE)
    spread = np.std(values, axis=0)
    return PolynomialBasis(
        mean=np.mean(values, axis=0), spread=np.where(spread > 0.0, spread, 1.0), degree=DEGREE
    )


def extended(
    pool: Pool | None,
    joining: Joining,
    *,
    drawn_from: IntArray,
    new: Sequence[FittedMoves],
    optimism: Sequence[FloatArray],
    terms: Terms,
    last: bool = False,
    planned: Planned | None = None,
) -> Pool:
    """The pool with more rollouts.

    Args:
        pool: What was drawn before, or ``None``.
        joining: More rollouts.
        drawn_from: Index of each one's proposal in the extended list, ``[n]``, those among them
            that do not join.
        new: Proposals that the pool does not know yet.
        optimism: By how much each new proposal overstates the log likelihood of the pool's
            rollouts, which it was fitted to, ``[N]``.
        terms: What likelihoods are taken with.
        last: Nothing is fitted to these rollouts, so that their decisions need not be kept.
        planned: Of a large final batch, of which no more is kept than an average needs: weights of
            those that violate.
    """
    proposals = (*(pool.proposals if pool else ()), *new)
    scored = joining.scored
    if pool is None:
        return _joining_of(joining, drawn_from, proposals, terms)
    if planned is None:
        fresh = _joining_of(joining, drawn_from, proposals, terms)
    else:
        fresh = _failing_of(scored, drawn_from, proposals, terms, planned=planned, first=pool.count)
    return _joined(_under_new(pool, new, optimism, terms), fresh, last=last)


def _joining_of(
    joining: Joining,
    drawn_from: IntArray,
    proposals: tuple[FittedMoves, ...],
    terms: Terms,
) -> Pool:
    """The pool of one stage alone."""
    own = drawn_from if joining.row is None else drawn_from[joining.row]
    pool = _pool_of(joining.scored, own, proposals, terms)
    return replace(
        pool, component=drawn_from, row=joining.row, log_stands_for=joining.log_stands_for
    )


def _pool_of(
    scored: ScoredRollouts,
    drawn_from: IntArray,
    proposals: tuple[FittedMoves, ...],
    terms: Terms,
) -> Pool:
    """The pool of ``scored`` alone."""
    decisions, latents, by_exploration = _fresh(scored.rollouts, terms)
    by_fitted = _of_fitted(decisions, latents, proposals, terms, count=scored.rollouts.count)
    after = [
        np.hstack([exploration[:, None], fitted])
        for exploration, fitted in zip(by_exploration, by_fitted, strict=True)
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
    *,
    planned: Planned,
    first: int,
) -> Pool:
    """The same of the violating rollouts alone, a few at a time; the others count.

    Their indices count from ``first``.
    """
    rows = np.flatnonzero(scored.violated).astype(np.int64)
    edges = np.linspace(0, rows.size, -(-rows.size // FAILING_AT_ONCE) + 1).astype(int)
    some = [rows[slice(*pair)] for pair in itertools.pairwise(edges.tolist())] or [rows]
    log_p, failing = np.full(drawn_from.size, np.nan), list[FailingWeights]()
    none = _pool_of(scored.take(slice(0)), drawn_from[:0], proposals, terms)
    for few in some:
        part = _pool_of(scored.take(few), drawn_from[few], proposals, terms)
        log_p[few] = part.log_p
        by_rule: dict[Rule, FloatArray] = {None: part.log_ratio, **part.rule_log_ratio}
        failing.append(FailingWeights.of(first + few, by_rule, planned))
    return replace(
        none,
        component=drawn_from,
        robustness=scored.robustness,
        violated=scored.violated,
        log_p=log_p,
        rule_robustness=scored.rule_robustness,
        broken=scored.broken,
        failing=tuple(failing),
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
    """Decisions, latents, and log likelihood of exploration over the model's under each rule."""
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
    by_exploration = _by_exploration(rollouts, acts, broken, terms)
    latents = fresh_latents(
        rollouts,
        features=terms.features,
        basis=terms.basis,
        turns=terms.turns,
        starts=terms.starts,
        rules=terms.rules,
        many=terms.many,
    )
    if latents is None:
        return decisions, None, by_exploration
    both = [
        first + second for first, second in zip(by_exploration, latents.by_exploration, strict=True)
    ]
    return decisions, latents.decisions, both


def _by_exploration(
    rollouts: RolloutBatch, acts: BoolArray, broken: BoolArray | None, terms: Terms
) -> Sequence[FloatArray]:
    """Log of the exploration proposals' likelihood over the model's, ``[n]`` under each rule."""
    family = ExplorationFamily.over(acts.shape[1], turns=terms.turns)
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
    decisions = pool.decisions
    if not last:
        moved = replace(fresh.decisions, rollout=fresh.decisions.rollout + pool.count)
        decisions = Decisions.concatenate([decisions, moved])
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
        failing=(*pool.failing, *fresh.failing),
        row=_rows(pool, fresh),
        log_stands_for=_stand_for(pool, fresh),
    )


def _rows(pool: Pool, fresh: Pool) -> IntArray | None:
    if pool.row is None and fresh.row is None:
        return None
    return np.concatenate([pool.rows, fresh.rows + pool.drawn])


def _stand_for(*pools: Pool) -> FloatArray | None:
    if all(pool.log_stands_for is None for pool in pools):
        return None
    own = (np.zeros(p.count) if p.log_stands_for is None else p.log_stands_for for p in pools)
    return np.concatenate([*own])


def _appended(before: Mapping[str, AnyArray], after: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    return {name: np.concatenate([values, after[name]]) for name, values in before.items()}


@dataclass(frozen=True, eq=False)
class FreshLatents:
    """Latents of rollouts that come to the pool.

    Attributes:
        decisions: As proposals see them.
        by_exploration: Log of the exploration proposals' density over the model's, ``[n]``, under
            all rules together and each of several.
    """

    decisions: LatentDecisions
    by_exploration: Sequence[FloatArray]


def fresh_latents(
    rollouts: RolloutBatch,
    *,
    features: StateFeatures,
    basis: PolynomialBasis,
    turns: int,
    starts: int,
    rules: Sequence[str] = (),
    many: bool = False,
) -> FreshLatents | None:
    """Of rollouts with latents that can be moved, ``starts`` at the start; ``None`` for others.

    Of ``many`` monomials are not made before they are asked for.
    """
    latents = rollouts.latents
    if latents is None or not (starts or latents.noise.shape[2]):
        return None
    states, acts = _last_turns(rollouts, turns)
    start, noise = latents.start[:, :starts], latents.noise.shape[2]
    family = LatentFamily.over(acts.shape[1], start=starts, noise=noise)
    acts = acts if noise else np.zeros_like(acts)
    broken = broken_at(states.memory, rules)
    detected = rollouts.detected[:, turns - 1 :: turns]
    values, own = noise_features(features, states, detected)[acts], noise_basis(basis)
    return FreshLatents(
        decisions=LatentDecisions(
            start=start,
            rollout=np.nonzero(acts)[0].astype(np.int64),
            monomials=Monomials(values, own) if many else own.evaluate(values),
            noise=latents.noise[acts],
            even=even_logit(np.nonzero(acts)[1], steps=acts.shape[1]),
            broken=None if broken is None else broken[acts],
        ),
        by_exploration=[
            family.log_ratio(start, latents.noise, within)
            for within in _until_each(acts, broken, rules)
        ],
    )


def _until_each(
    acts: BoolArray, broken: BoolArray | None, rules: Sequence[str]
) -> Sequence[BoolArray]:
    """Where noise counts under all rules together and under each, ``[N, T-1]``."""
    until = [still_open(broken, rules, rule) for rule in (None, *rules)]
    return [acts if each is None else acts & each for each in until]


def _last_turns(rollouts: RolloutBatch, turns: int) -> tuple[StateBatch, BoolArray]:
    """States before each step's last outcome ``[N, T-1]``, and whether nothing is violated yet."""
    count, steps = rollouts.detected.shape
    columns = slice(turns - 1, steps, turns)
    states = StateBatch(
        step=np.arange(steps, dtype=np.int64)[None, columns],
        signals={name: values[:, columns] for name, values in rollouts.signals.items()},
        memory={name: values[:, columns] for name, values in rollouts.memory.items()},
    )
    over = states.memory.get(VIOLATED, np.zeros((count, steps // turns), dtype=np.bool_))
    return states, ~over
