"""All rollouts of all stages, weighted as draws from the mixture of all proposals."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pemviz.arrays import AnyArray, Batch, BoolArray, FloatArray, IntArray
from pemviz.proposals.defensive_share import AgainstModel
from pemviz.proposals.latent_decisions import LatentDecisions
from pemviz.proposals.latent_means import LatentMeans
from pemviz.proposals.offset_logistic import PolynomialBasis, StateFeatures, shift
from pemviz.sampling.mixture.aims import Rule, still_open, where_open
from pemviz.sampling.mixture.final import (
    FailingWeights,
    log_shares,
    mostly_by_pilots,
    weights,
)
from pemviz.sampling.mixture.latents import latent_ratios
from pemviz.sampling.mixture.monomials import Monomials, some_at_once
from pemviz.types import RolloutBatch


@dataclass(frozen=True)
class Decisions(Batch):
    """The steps of N rollouts at which a proposal may differ from the error model.

    Attributes:
        rollout: Index of the rollout, ascending, ``[M]``.
        basis: ``[M, B]``; of many decisions not at once.
        missed: ``[M]``.
        offset: The error model's logit of a miss, ``[M]``.
        broken: Which rules are broken there, ``[M, R]``; ``None`` without several rules.
    """

    rollout: IntArray
    basis: FloatArray | Monomials
    missed: BoolArray
    offset: FloatArray
    broken: BoolArray | None = None


@dataclass(frozen=True, eq=False)
class FittedMoves:
    """How a fitted proposal leaves the error model.

    Attributes:
        coefficients: Of outcomes, ``[B]``.
        means: How it moves latents, where there are any.
        rule: Which it is to break, and until when it leaves the error model.
    """

    coefficients: FloatArray
    means: LatentMeans | None = None
    rule: Rule = None


@dataclass(frozen=True)
class Judged:
    """What an average over N rollouts is formed of.

    Attributes:
        log_weight: ``[N]``; NaN where a rollout holds and its weight is not known.
        violated: ``[N]``.
        component: What each was drawn from, ``[N]``.
        log_p: Log likelihood under the error model, ``[N]``; NaN likewise.
    """

    log_weight: FloatArray
    violated: BoolArray
    component: IntArray
    log_p: FloatArray


@dataclass(frozen=True)
class Pool:
    """Everything drawn so far: M rollouts of N, of which the others hold.

    Attributes:
        decisions: Of the M rollouts but the final ones.
        component: What each of all was drawn from, ``[N]``: 0 is the pilots' family, k the
            k-th fitted proposal.
        proposals: Each fitted one, K in all.
        log_ratio: Log q_k / p of each rollout under the family and each proposal, ``[M, 1 + K]``:
            of what it was until the rule at hand was broken. None of a large final batch's.
        robustness: ``[M]``.
        violated: ``[M]``.
        log_p: Log likelihood under the error model, ``[M]``.
        rule_robustness: ``[M]`` of each rule by name, where there are rules.
        broken: ``[M]`` likewise.
        rule_log_ratio: ``log_ratio`` under each, where there are several.
        latents: Of all rollouts but the final ones, where there are any.
        rule: The one at hand.
        failing: What is kept of a large final batch's violations, part by part; rollouts of it
            that hold only count.
        row: Which of the N rollouts the M are, ascending, ``[M]``; ``None``: all.
        log_stands_for: Log of how many rollouts each stands for where it is learned from, ``[M]``:
            more than itself if it holds and is of a large stage. ``None``: of itself.
    """

    decisions: Decisions
    component: IntArray
    proposals: tuple[FittedMoves, ...]
    log_ratio: FloatArray
    robustness: FloatArray
    violated: BoolArray
    log_p: FloatArray
    rule_robustness: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    broken: Mapping[str, BoolArray] = field(default_factory=dict[str, BoolArray])
    rule_log_ratio: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    latents: LatentDecisions | None = None
    rule: Rule = None
    failing: tuple[FailingWeights, ...] = ()
    row: IntArray | None = None
    log_stands_for: FloatArray | None = None

    @property
    def count(self) -> int:
        """Number of rollouts M."""
        return int(self.violated.size)

    @property
    def drawn(self) -> int:
        """Number of all rollouts N."""
        return int(self.component.size)

    @property
    def rows(self) -> IntArray:
        """Which of the N rollouts the M are, ``[M]``."""
        return np.arange(self.count, dtype=np.int64) if self.row is None else self.row

    @property
    def noisy(self) -> bool:
        """Whether steps have noise."""
        return self.latents is not None and self.latents.noise.shape[1] > 0

    @property
    def rules(self) -> tuple[str, ...]:
        """Those that are told apart; empty where there are not several."""
        return tuple(self.rule_log_ratio)

    @cached_property
    def open(self) -> BoolArray | None:
        """At which decisions the rule at hand is not broken yet, ``[M]``; ``None``: at all."""
        return still_open(self.decisions.broken, self.rules, self.rule)

    @cached_property
    def open_noise(self) -> BoolArray | None:
        """Likewise of steps with noise, ``[L]``."""
        broken = None if self.latents is None else self.latents.broken
        return still_open(broken, self.rules, self.rule)

    @property
    def varied(self) -> bool:
        """Whether rollouts start at several random values."""
        return self.latents is not None and self.latents.start.shape[1] > 1

    def under_rule(self, rule: str) -> "Pool":
        """The same rollouts under one rule: its robustness, its verdict, their ways until then."""
        return replace(
            self,
            robustness=self.rule_robustness[rule],
            violated=self.broken[rule],
            log_ratio=self.rule_log_ratio.get(rule, self.log_ratio),
            rule=rule,
        )

    def each_rule(self) -> "Sequence[Pool]":
        """The pool under every rule; itself where there is but the specification.

        Rules that the same rollouts break, some of them, are learned as one.
        """
        distinct: list[str] = []
        for rule, broken in self.broken.items():
            if not any(broken.any() and np.array_equal(broken, self.broken[o]) for o in distinct):
                distinct.append(rule)
        return [self.under_rule(rule) for rule in distinct] or [self]

    @cached_property
    def log_weight(self) -> FloatArray:
        """Log weights ``[M]`` by the balance heuristic: log p / sum_k (n_k / N) q_k.

        Veach & Guibas 1995; every rollout counts as a draw from the mixture, and those that stand
        for others as these, too. NaN of those of a large final batch that hold.
        """
        found = self._with_final(
            balance_weights(self.log_ratio, self.component),
            [(part.rollout, part.log_weight) for part in self.failing],
        )
        return found if self.log_stands_for is None else found + self.log_stands_for

    @property
    def judged(self) -> Judged:
        """What an average over all N rollouts is formed of."""
        return Judged(
            log_weight=self._among_all(self.log_weight, np.nan),
            violated=self._among_all(self.violated, False),
            component=self.component,
            log_p=self._among_all(self.log_p, np.nan),
        )

    def weights_among(self, part: slice) -> FloatArray:
        """Log weights ``[n]`` of a part of all rollouts, as draws from that part's own mixture.

        Args:
            part: The final batch, or what was drawn before it.
        """
        if not self.failing or part.stop is not None:
            own = slice(*np.searchsorted(self.rows, part.indices(self.drawn)[:2]).tolist())
            found = balance_weights(self.log_ratio[own], self.component[part])
            if self.row is None:
                return found
            among = np.full(self.component[part].size, np.nan)
            among[self.row[own] - part.indices(self.drawn)[0]] = found
            return among
        final = [(weights.rollout, weights.among_final) for weights in self.failing]
        found = self._with_final(np.full(len(self.log_ratio), np.nan), final)
        return self._among_all(found, np.nan)[part]

    def _among_all(self, values: AnyArray, fill: float | bool) -> AnyArray:
        """Of all rollouts, ``[N]`` of ``[M]``; ``fill`` of those that are not among the M."""
        if self.row is None:
            return values
        found = np.full(self.drawn, fill, dtype=values.dtype)
        found[self.row] = values
        return found

    @property
    def by_pilots(self) -> BoolArray:
        """Whether pilots are most of what could draw each of the F violations, ``[F]``."""
        learned, shares = self.violated[: len(self.log_ratio)], self._log_shares
        final = [
            weights.by_pilots[self._until][self.violated[weights.rollout]]
            for weights in self.failing
        ]
        return np.concatenate([mostly_by_pilots(self.log_ratio[learned], shares), *final])

    @property
    def _until(self) -> Rule:
        """The rule until which rollouts count: none where there are not several."""
        return self.rule if self.rule in self.rule_log_ratio else None

    @property
    def _log_shares(self) -> FloatArray:
        return log_shares(np.bincount(self.component, minlength=self.log_ratio.shape[1]))

    def _with_final(
        self, before: FloatArray, final: Sequence[tuple[IntArray, Mapping[Rule, FloatArray]]]
    ) -> FloatArray:
        """Weights ``[M]``, of those of a large final batch that violate."""
        found = np.full(self.count, np.nan)
        found[: before.size] = before
        for rollout, under in final:
            found[rollout] = under[self._until]
        return found


def balance_weights(log_ratio: FloatArray, component: IntArray) -> FloatArray:
    """-log sum_k (n_k / N) exp(log_ratio_k), ``[H]``.

    Args:
        log_ratio: Of H of the rollouts, ``[H, K]``.
        component: Of all that the shares are counted of, ``[N]``.
    """
    return weights(log_ratio, log_shares(np.bincount(component, minlength=log_ratio.shape[1])))


def decisions_of(
    rollouts: RolloutBatch,
    acts: BoolArray,
    *,
    features: StateFeatures,
    basis: PolynomialBasis,
    broken: BoolArray | None = None,
    many: bool = False,
) -> Decisions:
    """The decisions of N rollouts, made where ``acts [N, T-1]``, by the rules broken there.

    Of ``many`` monomials are not made before they are asked for.
    """
    values = features.values(rollouts.decision_states())
    values = np.broadcast_to(values, (*acts.shape, basis.mean.size))[acts]
    return Decisions(
        rollout=np.nonzero(acts)[0].astype(np.int64),
        basis=Monomials(values, basis) if many else basis.evaluate(values),
        missed=~rollouts.detected[acts],
        offset=-rollouts.pem_logit[acts],
        broken=None if broken is None else broken[acts],
    )


def log_ratios(
    decisions: Decisions,
    proposals: Sequence[FittedMoves],
    *,
    count: int,
    defensive: float,
    rules: Sequence[str] = (),
    under: Sequence[Rule] = (None,),
    latents: LatentDecisions | None = None,
) -> Sequence[FloatArray]:
    """Log q_k / p of N rollouts under K fitted proposals, ``[N, K]`` under each rule asked for.

    Args:
        decisions: The rollouts'.
        proposals: K.
        count: Number of rollouts N.
        defensive: Share of the error model in every outcome's probability.
        rules: Names of those that are told apart.
        under: Until when rollouts are judged.
        latents: The rollouts', where there are any.
    """
    found = _of_outcomes(
        decisions, proposals, count=count, defensive=defensive, rules=rules, under=under
    )
    if latents is not None:
        moves = [(one.means, one.rule) for one in proposals if one.means is not None]
        found = [
            each + latent_ratios(latents, moves, rules=rules, under=rule)
            for each, rule in zip(found, under, strict=True)
        ]
    return found


def _of_outcomes(
    decisions: Decisions,
    proposals: Sequence[FittedMoves],
    *,
    count: int,
    defensive: float,
    rules: Sequence[str],
    under: Sequence[Rule],
) -> Sequence[FloatArray]:
    """What :func:`log_ratios` finds of outcomes; of many decisions some rollouts at a time."""
    if isinstance(decisions.basis, Monomials):
        edges = some_at_once(count)
        places = np.searchsorted(decisions.rollout, edges).tolist()
        some = [
            _of_outcomes(
                _made(decisions, slice(*rows), first=first),
                proposals,
                count=stop - first,
                defensive=defensive,
                rules=rules,
                under=under,
            )
            for (first, stop), rows in zip(
                itertools.pairwise(edges), itertools.pairwise(places), strict=True
            )
        ]
        return [np.concatenate(parts) for parts in zip(*some, strict=True)]
    found = [np.zeros((count, len(proposals))) for _ in under]
    against = AgainstModel.of(decisions.offset, decisions.missed, share=defensive)
    for column, one in enumerate(proposals):
        step = against.log_ratio(shift(decisions.basis, one.coefficients))
        step = where_open(step, still_open(decisions.broken, rules, one.rule) if one.rule else None)
        for each, rule in zip(found, under, strict=True):
            until = still_open(decisions.broken, rules, rule)
            weights = where_open(step, until)
            each[:, column] = np.bincount(decisions.rollout, weights=weights, minlength=count)
    return found


def _made(decisions: Decisions, rows: slice, *, first: int) -> Decisions:
    """Some decisions with their monomials, of rollouts that count from ``first``."""
    some = decisions.take(rows)
    return replace(some, rollout=some.rollout - first, basis=some.basis[:])
