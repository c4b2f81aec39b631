"""All rollouts of all stages, weighted as draws from the mixture of all proposals.

Whether a rule, of several, is broken is known as soon as it is, and what a rollout is sampled from
later tells nothing more of it. So a proposal that is fitted to the ways of breaking a rule leaves
the error model until that rule is broken, and a rollout's likelihood under a rule is that of its
outcomes up to there: what comes later would only spread the weights. Of the rules together, that at
least one is broken, it is that of the outcomes up to the first.

Of a large final batch only its violations' weights are kept, as all its proposals are known before.
"""

import itertools
import math
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pemviz.arrays import AnyArray, Batch, BoolArray, FloatArray, IntArray, log_sum_exp
from pemviz.proposals.latent_moves import LatentDecisions, LatentMeans
from pemviz.proposals.offset_logistic import Monomials, outcome_ratios, shift, some_at_once
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.mixture.failure_modes import shares_of_rollouts
from pemviz.types import violated_rule

EXPLORATION, PLAIN = 0, 1
"""The components that stand for the exploration proposals' family and for the error model itself,
which is the first proposal of every pool; the fitted ones count from 2."""
ROWS_AT_ONCE = 1 << 14
"""Of ratios, whose exponentials take several times their own memory."""
MORE_THAN_HALF = 0.5
IN_NO_WEIGHT = 700.0
"""Nats by which a proposal is told to flatter a rollout, whose weight it is to have no part in."""
Rule = str | None
"""A rule's name; ``None``: all rules together, or the specification where there is none."""


@dataclass(frozen=True)
class Planned:
    """Logs of the shares of rollouts that are sampled from each component, once all are.

    Attributes:
        of_all: ``[1 + K]``.
        of_final: Of the final batch alone, ``[1 + K]``.
    """

    of_all: FloatArray
    of_final: FloatArray

    @staticmethod
    def of(
        sizes: Sequence[int],
        components: Callable[[int], IntArray],
        *,
        before: IntArray,
        proposals: int,
    ) -> "Planned":
        """Before any of the parts is sampled, or between two.

        ``components`` are what each rollout of a part of a size is sampled from, ``before`` those
        of the rollouts before the final batch; proposals are K.
        """
        columns = 1 + proposals
        final = np.zeros(columns, dtype=np.int64)
        for size, times in Counter(sizes).items():
            final += times * np.bincount(components(size), minlength=columns)
        of_all = final + np.bincount(before, minlength=columns)
        return Planned(of_all=log_shares(of_all), of_final=log_shares(final))


@dataclass(frozen=True)
class FailingWeights:
    """Weights of violating final rollouts until each rule is broken, and until any is (``None``).

    Attributes:
        rollout: Index of each in the pool, ascending, ``[F]``.
        log_weight: As draws from the mixture of all stages, ``[F]``.
        among_final: As draws from the final batch's own, ``[F]``.
        by_exploration: Whether exploration proposals are most of what could draw it, ``[F]``.
    """

    rollout: IntArray
    log_weight: Mapping[Rule, FloatArray]
    among_final: Mapping[Rule, FloatArray]
    by_exploration: Mapping[Rule, BoolArray]

    @staticmethod
    def of(
        rollout: IntArray, log_ratio: Mapping[Rule, FloatArray], planned: Planned
    ) -> "FailingWeights":
        """From the log ratios ``[F, 1 + K]`` under each rule."""
        ratios = log_ratio.items()
        return FailingWeights(
            rollout=rollout,
            log_weight={rule: weights(ratio, planned.of_all) for rule, ratio in ratios},
            among_final={rule: weights(ratio, planned.of_final) for rule, ratio in ratios},
            by_exploration={
                rule: mostly_by_exploration(ratio, planned.of_all) for rule, ratio in ratios
            },
        )


def log_shares(counts: IntArray) -> FloatArray:
    """Log of the share n_k / N of rollouts drawn from each of K components, ``[K]``."""
    with np.errstate(divide="ignore"):  # a proposal that nothing was sampled from does not count
        return np.log(counts / counts.sum())


def weights(log_ratio: FloatArray, shares: FloatArray) -> FloatArray:
    """-log sum_k exp(share_k + log_ratio_k) for ratios ``[H, K]`` and log shares ``[K]``."""
    found = np.empty(len(log_ratio))
    for first in range(0, len(log_ratio), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        found[rows] = -np.asarray(log_sum_exp(log_ratio[rows] + shares, axis=1))
    return found


def mostly_by_exploration(log_ratio: FloatArray, shares: FloatArray) -> BoolArray:
    """Whether exploration proposals are most of what could draw each of ``[H]`` rollouts."""
    log_joint = log_ratio + shares
    by_exploration = np.exp(log_joint[:, EXPLORATION] - np.asarray(log_sum_exp(log_joint, axis=1)))
    return by_exploration > MORE_THAN_HALF


@dataclass(frozen=True, eq=False)
class TargetRules:
    """The rule that each of N rollouts is sampled to break.

    Attributes:
        rules: Names of all; empty where there is but the specification.
        chosen: Which of them, ``[N]``; -1: none by itself.
    """

    rules: tuple[str, ...]
    chosen: IntArray

    @staticmethod
    def of(rules: tuple[str, ...], targets: Sequence[Rule]) -> "TargetRules":
        """Of rollouts by name."""
        places = {None: -1, **{rule: place for place, rule in enumerate(rules)}}
        return TargetRules(
            rules, np.array([places.get(rule, -1) for rule in targets], dtype=np.int64)
        )

    def reached(self, memory: Mapping[str, AnyArray]) -> BoolArray:
        """Which rollouts have broken theirs, ``[N]``, by what states remember."""
        found = self.chosen != self.chosen
        for place, rule in enumerate(self.rules):
            found = found | (memory[violated_rule(rule)] & (self.chosen == place))
        return found

    def rows(self, rows: slice) -> "TargetRules":
        """Of some of the rollouts."""
        return TargetRules(self.rules, self.chosen[rows])


def broken_at(memory: Mapping[str, AnyArray], rules: Sequence[str]) -> BoolArray | None:
    """Which rules are broken at states ``[...]``, ``[..., R]``; ``None`` without rules."""
    if not rules:
        return None
    return np.stack([memory[violated_rule(rule)] for rule in rules], axis=-1)


def still_open(broken: BoolArray | None, rules: Sequence[str], rule: Rule) -> BoolArray | None:
    """Where a rule is not broken yet, ``[...]`` of ``[..., R]``; ``None`` stands for everywhere."""
    if broken is None:
        return None
    closed = broken.any(axis=-1) if rule is None else broken[..., rules.index(rule)]
    return np.logical_not(np.asarray(closed))


def where_open(values: AnyArray, open_there: BoolArray | None) -> AnyArray:
    """The values, 0 elsewhere."""
    return values if open_there is None else np.where(open_there, values, 0.0)


@dataclass(frozen=True)
class Decisions(Batch):
    """The steps of N rollouts at which a proposal may differ from the error model.

    Attributes:
        rollout: Index of the rollout, ascending, ``[M]``.
        basis: ``[M, B]``; of many decisions not at once.
        missed: ``[M]``.
        offset: The error model's logit of a miss, ``[M]``.
        step: Which of its rollout's outcomes each is, ``[M]``.
        broken: Which rules are broken there, ``[M, R]``; ``None`` without several rules.
    """

    rollout: IntArray
    basis: FloatArray | Monomials
    missed: BoolArray
    offset: FloatArray
    step: IntArray
    broken: BoolArray | None = None


@dataclass(frozen=True, eq=False)
class FittedMoves:
    """How a fitted proposal leaves the error model.

    Attributes:
        coefficients: Of outcomes, ``[B]``.
        means: How it moves latents, where there are any.
        rule: Which it is to break, and until when it leaves the error model.
        defensive: Share of the error model in every outcome's probability; ``None``: the least.
        by_step: By how much it raises a miss's logit at each step besides, ``[T-1]``; ``None``: by
            nothing.
    """

    coefficients: FloatArray
    means: LatentMeans | None = None
    rule: Rule = None
    defensive: float | None = None
    by_step: FloatArray | None = None


@dataclass(frozen=True)
class Judged:
    """What an average over N rollouts is formed of.

    Attributes:
        log_weight: ``[N]``; NaN where a rollout holds and its weight is not known.
        violated: ``[N]``.
        component: What each was sampled from, ``[N]``.
        log_p: Log likelihood under the error model, ``[N]``; NaN likewise.
    """

    log_weight: FloatArray
    violated: BoolArray
    component: IntArray
    log_p: FloatArray


@dataclass(frozen=True)
class Verdict:
    """What a formula says of M rollouts.

    Attributes:
        robustness: ``[M]``.
        violated: ``[M]``.
    """

    robustness: FloatArray
    violated: BoolArray


Verdicts = Mapping[Rule, tuple[Verdict, ...]]


@dataclass(frozen=True)
class Pool:
    """Everything drawn so far: M rollouts of N, of which the others hold.

    Attributes:
        decisions: Of the M rollouts but the final ones.
        component: What each of all was sampled from, ``[N]``: 0 is the exploration proposals'
            family, k the k-th proposal.
        proposals: The error model itself, then each fitted one, K in all.
        log_ratio: Log q_k / p of each rollout under the family and each proposal, ``[M, 1 + K]``:
            of what it was until the rule at hand was broken. None of a large final batch's.
        robustness: ``[M]``.
        violated: ``[M]``.
        log_p: Log likelihood under the error model, ``[M]``.
        rule_robustness: ``[M]`` of each rule by name, where there are rules.
        broken: ``[M]`` likewise.
        rule_log_ratio: ``log_ratio`` under each, where there are several.
        lowered: By how much ``log_ratio`` is lowered, to first order and under every rule alike, of
            the rollouts that a proposal was fitted to, ``[M, 1 + K]``; ``None``: of none.
        conjuncts: Verdicts of the conjuncts of each rule that has some, of the rollouts that
            proposals are fitted to.
        share: Of the rollouts, for proposals that are to violate what is at hand, beside others.
        latents: Of all rollouts but the final ones, where there are any.
        start: Latents at the start of all, ``[M, S]``, where proposals move some.
        rule: The one at hand.
        failing: What is kept of a large final batch's violations, part by part; rollouts of it
            that hold only count.
        row: Which of the N rollouts the M are, ascending, ``[M]``; ``None``: all.
        log_stands_for: Log of how many rollouts each stands for where it is learned from, ``[M]``:
            more than itself if it holds and is of a large stage. ``None``: of itself.
        steps: Outcomes of a rollout, T-1.
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
    lowered: AnyArray | None = None
    conjuncts: Verdicts = field(default_factory=dict[Rule, tuple[Verdict, ...]])
    share: float = 1.0
    latents: LatentDecisions | None = None
    start: FloatArray | None = None
    rule: Rule = None
    failing: tuple[FailingWeights, ...] = ()
    row: IntArray | None = None
    log_stands_for: FloatArray | None = None
    steps: int = 0

    @property
    def count(self) -> int:
        """Number of rollouts M."""
        return int(self.violated.size)

    @property
    def sampled(self) -> int:
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

    def each_target(self) -> "Sequence[Pool]":
        """The pool under every rule's conjuncts; itself where there is but the specification.

        Those that the same rollouts violate, some of them, are learned as one.
        """
        distinct: list[str] = []
        for rule, broken in self.broken.items():
            if not any(broken.any() and np.array_equal(broken, self.broken[o]) for o in distinct):
                distinct.append(rule)
        pools = [self.under_rule(rule) for rule in distinct] or [self]
        return [part for one in pools for part in one.each_conjunct()]

    def each_conjunct(self) -> "Sequence[Pool]":
        """Under each conjunct of the rule at hand, with shares by what it has of the estimate."""
        parts: list[Pool] = []
        for verdict in self.conjuncts.get(self.rule, ()):
            violated = verdict.violated & self.violated
            if violated.any() and any(np.array_equal(violated, one.violated) for one in parts):
                continue
            parts.append(replace(self, robustness=verdict.robustness, violated=violated))
        if len(parts) < 2:
            return [self]
        weight = np.exp(self.log_weight - np.max(self.log_weight[self.violated], initial=-np.inf))
        share = np.array([weight[one.violated].sum() for one in parts])
        if not share.any():
            return [replace(one, share=self.share / len(parts)) for one in parts]
        shares = shares_of_rollouts(share / share.sum())
        return [
            replace(one, share=self.share * own) for one, own in zip(parts, shares, strict=True)
        ]

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
    def correction_error(self) -> float:
        """How far off an average may be as fits were corrected for their own rollouts [nats].

        The correction is the infinitesimal jackknife's, of first order in what a rollout pulls.
        What it leaves out is of second order, the average of its squares; where few rollouts decide
        a fit, that is more than all of it, and it is as uncertain as it is large.
        """
        if self.lowered is None or not self.violated.any():
            return 0.0
        row = np.flatnonzero(self.violated[: len(self.log_ratio)])
        lowered = self.lowered[row].astype(np.float64)
        lowered[lowered >= IN_NO_WEIGHT] = 0.0
        before = balance_weights(self.log_ratio[row] + lowered, self.component)
        own = self.log_weight[row]
        share = np.exp(own - log_sum(self.log_weight[self.violated]))
        pulled = own - before
        uncorrected = 1.0 + float(share @ np.expm1(-pulled))
        first = -math.log(max(uncorrected, sys.float_info.min))
        return min(first, float(share @ pulled**2))

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
        """Log weights ``[n]`` of a part of all rollouts, as samples from that part's own mixture.

        The part is the final batch, or what was sampled before it.
        """
        if not self.failing or part.stop is not None:
            own = slice(*np.searchsorted(self.rows, part.indices(self.sampled)[:2]).tolist())
            found = balance_weights(self.log_ratio[own], self.component[part])
            if self.row is None:
                return found
            among = np.full(self.component[part].size, np.nan)
            among[self.row[own] - part.indices(self.sampled)[0]] = found
            return among
        final = [(weights.rollout, weights.among_final) for weights in self.failing]
        found = self._with_final(np.full(len(self.log_ratio), np.nan), final)
        return self._among_all(found, np.nan)[part]

    def _among_all(self, values: AnyArray, fill: float | bool) -> AnyArray:
        """Of all rollouts, ``[N]`` of ``[M]``; ``fill`` of those that are not among the M."""
        if self.row is None:
            return values
        found = np.full(self.sampled, fill, dtype=values.dtype)
        found[self.row] = values
        return found

    @property
    def by_exploration(self) -> BoolArray:
        """Whether exploration is most of what could draw each of the F violations, ``[F]``."""
        learned = self.violated[: len(self.log_ratio)]
        shares = log_shares(np.bincount(self.component, minlength=self.log_ratio.shape[1]))
        final = [
            weights.by_exploration[self._until][self.violated[weights.rollout]]
            for weights in self.failing
        ]
        return np.concatenate([mostly_by_exploration(self.log_ratio[learned], shares), *final])

    def _with_final(
        self, before: FloatArray, final: Sequence[tuple[IntArray, Mapping[Rule, FloatArray]]]
    ) -> FloatArray:
        """Weights ``[M]``, of those of a large final batch that violate."""
        found = np.full(self.count, np.nan)
        found[: before.size] = before
        for rollout, under in final:
            found[rollout] = under[self._until]
        return found

    @property
    def _until(self) -> Rule:
        """The rule until which rollouts count: none where there are not several."""
        return self.rule if self.rule in self.rule_log_ratio else None


def balance_weights(log_ratio: FloatArray, component: IntArray) -> FloatArray:
    """-log sum_k (n_k / N) exp(log_ratio_k), ``[H]``.

    Of H of the rollouts, for ratios ``[H, K]``; shares are counted of components ``[N]``.
    """
    return weights(log_ratio, log_shares(np.bincount(component, minlength=log_ratio.shape[1])))


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
    """Log q_k / p of N rollouts under K fitted proposals, ``[N, K]`` under each of some rules.

    ``defensive`` is the share of the error model in every outcome's probability, ``rules`` are the
    names of all, ``under`` those until which rollouts are judged.
    """
    if isinstance(decisions.basis, Monomials):
        found = _some_at_a_time(decisions, proposals, count, defensive, rules, under)
    else:
        found = [np.zeros((count, len(proposals))) for _ in under]
        shares = [defensive if one.defensive is None else one.defensive for one in proposals]
        by_share = {
            share: outcome_ratios(decisions.offset, decisions.missed, share=share)
            for share in dict.fromkeys(shares)
        }
        until = [still_open(decisions.broken, rules, rule) for rule in under]
        for column, one in enumerate(proposals):
            if one.by_step is None and not one.coefficients.any():  # the error model itself
                continue
            raised = shift(decisions.basis, one.coefficients)
            if one.by_step is not None:
                raised += one.by_step[decisions.step]
            step = by_share[shares[column]](raised)
            own = still_open(decisions.broken, rules, one.rule) if one.rule else None
            step = where_open(step, own)
            for each, open_there in zip(found, until, strict=True):
                weights = where_open(step, open_there)
                each[:, column] = np.bincount(decisions.rollout, weights=weights, minlength=count)
    if latents is None:
        return found
    moves = [(one.means, one.rule) for one in proposals if one.means is not None]
    return [
        each + latent_ratios(latents, moves, rules=rules, under=rule)
        for each, rule in zip(found, under, strict=True)
    ]


def _some_at_a_time(  # noqa: PLR0917  as log_ratios takes them
    decisions: Decisions,
    proposals: Sequence[FittedMoves],
    count: int,
    defensive: float,
    rules: Sequence[str],
    under: Sequence[Rule],
) -> list[FloatArray]:
    """What :func:`log_ratios` finds of outcomes, with monomials of some rollouts at a time."""
    edges = some_at_once(count)
    places = itertools.pairwise(np.searchsorted(decisions.rollout, edges).tolist())
    found: list[Sequence[FloatArray]] = []
    for (first, stop), rows in zip(itertools.pairwise(edges), places, strict=True):
        some = decisions.take(slice(*rows))
        some = replace(some, rollout=some.rollout - first, basis=some.basis[:])
        count = stop - first
        found.append(
            log_ratios(some, proposals, count=count, defensive=defensive, rules=rules, under=under)
        )
    return [np.concatenate(parts) for parts in zip(*found, strict=True)]


def latent_ratios(
    latents: LatentDecisions,
    moves: Sequence[tuple[LatentMeans, Rule]],
    *,
    rules: Sequence[str] = (),
    under: Rule = None,
) -> FloatArray:
    """Log q_k / p ``[N, K]`` of the latents of N rollouts under fitted proposals.

    ``moves`` are means of each proposal, and the rule that it is to break; the others as above.
    """
    if isinstance(latents.monomials, Monomials):
        edges = itertools.pairwise(some_at_once(latents.count))
        pieces = (latents.between(*pair) for pair in edges)
        return np.vstack([latent_ratios(few, moves, rules=rules, under=under) for few in pieces])
    found = np.zeros((latents.count, len(moves)))
    until = still_open(latents.broken, rules, under)
    for rule in dict.fromkeys(rule for _, rule in moves):
        own = still_open(latents.broken, rules, rule) if rule else None
        counted = latents.where(until if own is None else own if until is None else own & until)
        for column, (means, of) in enumerate(moves):
            if of == rule:
                found[:, column] = means.log_ratio(counted)
    return found
