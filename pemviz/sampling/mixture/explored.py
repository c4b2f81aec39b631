"""Failure modes that Markov chains find before proposals are fitted, or that exploration meets.

A proposal is fitted to violations that were met, and what was never met shows neither in weights
nor in what is computed from them. Where rollouts begin at random or noise enters at each step,
violations may lie on several sides of what is likely. So chains that know no proposal search first
(:mod:`pemviz.sampling.subset.exploring`). Their violations follow the model where it violates: what
a proposal is to be (Chan, Kroese 2012 fit it to such chains). One is fitted for each failure mode
that they tell apart, and these keep a share of every stage. The chains' violations are not part
of the estimate.

So are proposals to violations that exploration met, moved
(:mod:`pemviz.sampling.mixture.rejuvenated`), but only as long as the pool cannot tell how much of
the estimate their modes have; and to those that proposals sampled, moved
(:mod:`pemviz.sampling.mixture.resampled`), where they came to what the pool hardly samples. With
w = p / q of the pool's mixture q, a mode with the share a of the estimate mu is expected
a N mu / E[w] times at least among the pool's N rollouts, with E over what the model does in the
mode. Where N mu / w is less than a handful, the mode may have any share, and nothing that is
computed from weights would show it; up to a hundred, a share of some per cent is told by a handful.

What chains found and what was moved check the estimate. With m = E[w | violates], rollouts of q
vary by mu m - mu^2: where q hardly samples what they have come to, m is large, whatever the weights
of rollouts of q say. And independent chains' own estimates of mu have no bias. That they find less
says nothing against an average of weights, which overlooks and does not invent; finding more does.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logit, stdtrit

from pemviz.arrays import BoolArray, FloatArray, IntArray, log_sum_exp
from pemviz.proposals.offset_logistic import LARGEST_SHIFT, PolynomialBasis
from pemviz.sampling.estimates.diagnostics import (
    chains_disagreement,
    hardly_sampled,
)
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size
from pemviz.sampling.method import VIOLATION_THRESHOLD
from pemviz.sampling.mixture.balance_heuristic import (
    IN_NO_WEIGHT,
    FittedMoves,
    Pool,
    Rule,
    log_shares,
)
from pemviz.sampling.mixture.fit import (
    Elites,
    Fit,
    FitSettings,
    fits_to_failures,
    fitted,
    nearest_modes,
)
from pemviz.sampling.mixture.pooling import Terms, error_model, pool_of
from pemviz.sampling.mixture.rejuvenated import Rejuvenated
from pemviz.sampling.mixture.resampled import Resampled
from pemviz.sampling.mixture.surrogate import LearnedOnSurrogate
from pemviz.sampling.subset.exploring import Explored
from pemviz.types import Diagnostic, Estimate, ScoredRollouts

LEAST_SCATTER, PRICE = 2.0, 0.3
"""Failure modes are told apart readily: one too many costs a few rollouts."""
SHARE = 0.25
"""Of a stage's rollouts that are not exploration proposals, sampled from the chains' proposals."""
SURROGATE_SHARE, LATER_SHARE = 0.5, 0.25
"""Of the second stage's rollouts that are not exploration proposals, sampled from the surrogate's,
and of every later one's, as long as the surrogate's probability is near the simulator's."""
NEAR = 1.0
"""In decades; farther apart, they are systems that fail in other ways."""
ENOUGH = 100.0
"""Rollouts of a failure mode, if all of the estimate were of it, that make its share known. With 10
two of 16 estimates of four branches alike were a fifth low, for want of one of them."""
LARGEST_SCARCE, FEW_OF_A_MODE = 0.5, 10.0
"""Share of a mode whose rollouts may be too few beside others', and rollouts that tell no share."""
MOST_MODES, MOST_UNSEEN = 5, 0.5
"""Of which proposals have the misses that they need; probability of one that none has needed."""
LEVEL = 0.995
"""Of the two-sided interval that the chains' estimates are compared by: 99 %."""
MOST_NATS = 700.0
"""Of which the exponential is a float64."""


def explored_fits(
    explored: Explored, *, terms: Terms, basis: PolynomialBasis, settings: FitSettings
) -> tuple[Fit, ...]:
    """A proposal for each failure mode among what the chains found."""
    if explored.scored is None:
        return ()
    settings = replace(settings, independent=explored.independent)
    # all count alike: by what its run found, one run's would hide the modes that others met
    return tuple(_fits_to_modes(_all_alike(explored.scored, terms), basis, settings))


def _all_alike(scored: ScoredRollouts, terms: Terms) -> Pool:
    """A pool of rollouts that follow the model where it violates."""
    pool = pool_under(scored, (error_model(scored.rollouts, terms),), terms)
    zeros = {rule: np.zeros_like(ratio) for rule, ratio in pool.rule_log_ratio.items()}
    return replace(pool, log_ratio=np.zeros_like(pool.log_ratio), rule_log_ratio=zeros)


def _fits_to_modes(pool: Pool, basis: PolynomialBasis, settings: FitSettings) -> Sequence[Fit]:
    return fits_to_failures(pool, basis, settings, least_scatter=LEAST_SCATTER, price=PRICE)


def fits_to_unknown(
    found: Rejuvenated,
    resampled: Resampled,
    pool: Pool,
    *,
    terms: Terms,
    basis: PolynomialBasis,
    settings: FitSettings,
) -> Sequence[Fit]:
    """A proposal for each mode whose share of the estimate the pool cannot tell yet.

    Of those that exploration proposals have met, as rollouts that were moved; of each rule's. And
    for those that are known by the misses that they need, one with these misses. And for what the
    pool's own violations became, where it hardly samples that.
    """
    kinds = (
        *_fits_to_rejuvenated(found, pool, terms, basis, settings),
        _fits_to_resampled(resampled, pool, terms, basis, settings),
    )
    kinds = [alike for alike in kinds if alike]
    return [replace(fit, share=1.0 / len(alike) / len(kinds)) for alike in kinds for fit in alike]


def _fits_to_rejuvenated(
    found: Rejuvenated, pool: Pool, terms: Terms, basis: PolynomialBasis, settings: FitSettings
) -> tuple[Sequence[Fit], Sequence[Fit]]:
    """To rollouts that were moved, and to the misses that some of them need."""
    moved, fits, needing = found.scored, list[Fit](), list[Fit]()
    if moved is None:
        return fits, needing
    own, none = pool_under(moved, pool.proposals, terms), np.zeros(pool.count)
    for rule in terms.rules or (None,):
        theirs, all_of_it = (_under(each, rule) for each in (own, pool))
        unknown = _scarce(theirs, all_of_it)
        for rows in _hardly_known(found, all_of_it):
            unknown[rows] = True
        unknown &= theirs.violated
        if unknown.any():
            fits += _fits_to_some(moved.take(unknown), rule, terms, basis, settings)
            needing += _fits_to_needed(found, unknown, rule, terms, basis, settings)
    fits, needing = ([replace(fit, optimism=none) for fit in some] for some in (fits, needing))
    return fits, needing


def _fits_to_resampled(
    found: Resampled, pool: Pool, terms: Terms, basis: PolynomialBasis, settings: FitSettings
) -> Sequence[Fit]:
    """To what violations became where the pool has but a few rollouts, if all of it were there."""
    fits = list[Fit]()
    if found.scored is None:
        return fits
    own = pool_under(found.scored, pool.proposals, terms)
    for rule in terms.rules or (None,):
        theirs = _under(own, rule)
        scarce = _scarce(theirs, _under(pool, rule)) & theirs.violated & found.moved
        if not scarce.any():
            continue
        ancestor = found.ancestor[scarce]
        families = np.unique(ancestor)
        optimism = np.zeros(pool.count)
        optimism[families] = IN_NO_WEIGHT
        known = replace(settings, independent=families.size / ancestor.size)
        some = _fits_to_some(found.scored.take(scarce), rule, terms, basis, known)
        fits += [replace(fit, optimism=optimism) for fit in some]
    return fits


def _fits_to_some(
    some: ScoredRollouts, rule: Rule, terms: Terms, basis: PolynomialBasis, settings: FitSettings
) -> Sequence[Fit]:
    """To rollouts that break a rule or some of its conjuncts, each counted alike."""
    alike = _under(_all_alike(some, terms), rule).each_conjunct()
    fits = [_fits_to_modes(one, basis, settings) for one in alike if one.violated.any()]
    return [fit for each in fits for fit in each]


def _under(pool: Pool, rule: Rule) -> Pool:
    return pool if rule is None else pool.under_rule(rule)


def _scarce(own: Pool, pool: Pool) -> BoolArray:
    """Of which other rollouts the pool has too few, if all of its estimate were of their mode."""
    return log_pool_weight(own, pool) > _log_total(pool) - math.log(ENOUGH)


def _log_total(pool: Pool) -> float:
    return log_sum(pool.log_weight[pool.violated])


def _hardly_known(found: Rejuvenated, pool: Pool) -> Iterator[IntArray]:
    """Rows of the modes that the pool's own rollouts in them tell little of.

    What was moved is what proposals are fitted to, and may be sampled more often than all else in
    its mode.
    """
    violated = np.flatnonzero(pool.violated)
    mode = nearest_modes(pool, violated, found.needed_misses)
    for number, rows in enumerate(found.modes):
        log_weight = pool.log_weight[violated[mode == number]]
        if not log_weight.size:
            continue
        log_share = log_sum(log_weight) - _log_total(pool)
        enough = max(ENOUGH * math.exp(log_share), FEW_OF_A_MODE)
        if log_share < math.log(LARGEST_SCARCE) and effective_sample_size(log_weight) < enough:
            yield rows


def _fits_to_needed(  # noqa: PLR0917  as fits_to_unknown takes them
    found: Rejuvenated,
    unknown: BoolArray,
    rule: Rule,
    terms: Terms,
    basis: PolynomialBasis,
    settings: FitSettings,
) -> Iterator[Fit]:
    """A proposal with the misses that a mode needs, for the modes of most that is ``unknown``.

    A few rollouts of a mode tell little of how often each step is missed in it, but that it
    violates no more without these misses. Of n that need c at a step, it is missed with the
    probability (c + 1/2) / (n + 1), as Jeffreys' prior has it. Others that the mode may need are
    steps that none of them needs: as many in a rollout as there are steps that one of them needs,
    over n + 1 (Good 1953), near in time.
    """
    moved, scored = found.moved, found.scored
    assert moved is not None  # noqa: S101  there are no modes without
    assert scored is not None  # noqa: S101  what was moved has been
    of_unknown = [rows for rows in found.modes if unknown[rows].any()]
    for rows in sorted(of_unknown, key=lambda rows: -int(unknown[rows].sum()))[:MOST_MODES]:
        count = moved.needed_misses[rows].sum(axis=0)
        known, once = count > 0, int((count == 1).sum())
        unseen = (once * _nearness(known)).clip(max=MOST_UNSEEN * (rows.size + 1.0))
        miss = np.where(known, count + 0.5, unseen) / (rows.size + 1.0)
        raised = logit(miss) + moved.rollouts.pem_logit[rows].mean(axis=0)
        theirs, all_of_them = _all_alike(scored.take(rows), terms), np.ones(rows.size)
        elites = Elites(VIOLATION_THRESHOLD, all_of_them > 0.0)
        by_state = fitted(theirs, basis, elites, all_of_them, settings)  # for what starts it needs
        yield replace(
            by_state,
            coefficients=np.zeros_like(by_state.coefficients),
            rule=rule,
            by_step=raised.clip(0.0, LARGEST_SHIFT),
        )


def _nearness(needed: BoolArray) -> FloatArray:
    """How near each other step is to one that is ``needed``, as shares of all ``[T-1]``."""
    steps = np.arange(needed.size)
    far = np.abs(steps[:, None] - steps[needed]).min(axis=1).astype(np.float64)
    near = np.where(needed, 0.0, 1.0 / np.maximum(far, 1.0) ** 2)
    return near / max(float(near.sum()), float(np.finfo(float).tiny))


def with_explored(
    fits: Sequence[Fit], explored: Sequence[Fit], *, rollouts: int, share: float = SHARE
) -> tuple[Fit, ...]:
    """What a stage samples from, the main proposal first, those of chains or a surrogate last.

    ``rollouts`` are the pool's, to which the last were not fitted; ``share`` is that of them all.
    """
    if not explored:
        return tuple(fits)
    total, none = sum(fit.share for fit in explored), np.zeros(rollouts)
    return (
        *(replace(fit, share=(1.0 - share) * fit.share) for fit in fits),
        *(replace(fit, share=share * (fit.share / total), optimism=none) for fit in explored),
    )


def with_taught(
    fits: Sequence[Fit], taught: LearnedOnSurrogate, *, pool: Pool, stage: int
) -> tuple[Fit, ...]:
    """What a stage samples from, the surrogate's proposals last.

    Args:
        fits: Fitted to the pool.
        taught: By the surrogate.
        pool: The simulator's own rollouts.
        stage: Zero-based.
    """
    share = SURROGATE_SHARE if stage == 1 else LATER_SHARE
    if stage > 1 and pool.violated.any():
        log_probability = log_sum(pool.log_weight[pool.violated]) - math.log(pool.sampled)
        theirs = taught.estimate.log10_probability
        if theirs is None or abs(log_probability / math.log(10.0) - theirs) > NEAR:
            return tuple(fits)
    return with_explored(fits, taught.fits, rollouts=pool.count, share=share)


def against_chains(
    explored: Explored, resampled: Resampled, pool: Pool, estimate: Estimate, *, terms: Terms
) -> tuple[Diagnostic, ...]:
    """What is wrong with an estimate beside what chains found, and what violations became."""
    if estimate.probability == 0.0 or estimate.std_error is None:
        return ()
    log_estimate = math.log(10.0) * (estimate.log10_probability or 0.0)
    totals = () if pool.rule else _totals(explored.log_probability, log_estimate)
    by_chains = max(
        _relative_error(explored.scored, explored.log_weight, pool, log_estimate, terms),
        _relative_error(resampled.of_newest, None, pool, log_estimate, terms),
    )
    hardly = hardly_sampled(
        by_chains=by_chains, by_weights=estimate.std_error / estimate.probability
    )
    return (*totals, *hardly)


def _relative_error(
    scored: ScoredRollouts | None,
    log_p: FloatArray | None,
    pool: Pool,
    log_estimate: float,
    terms: Terms,
) -> float:
    """Of the estimate, as rollouts tell it that follow the model by their log weights ``[E]``.

    ``None``: all count alike.
    """
    if scored is None:
        return 0.0
    log_p = np.zeros(scored.violated.size) if log_p is None else log_p
    own = _under(pool_under(scored, pool.proposals, terms), pool.rule)
    if not own.violated.any():
        return 0.0
    log_weight, log_p = log_pool_weight(own, pool)[own.violated], log_p[own.violated]
    log_moment = log_sum(log_p + log_weight) - log_sum(log_p)
    excess = max(math.expm1(min(log_moment - log_estimate, MOST_NATS)), 0.0)
    return math.sqrt(excess / pool.sampled)


def _totals(log_probability: FloatArray, log_estimate: float) -> tuple[Diagnostic, ...]:
    """Runs whose logarithms are about normal tell the log of their mean's interval."""
    runs = log_probability.size
    if not (runs and np.isfinite(log_probability).all()):
        return ()
    variance = float(np.var(log_probability, ddof=1))
    centre = float(np.mean(log_probability)) + 0.5 * variance
    half = float(stdtrit(runs - 1, LEVEL)) * math.sqrt(
        variance / runs + 0.5 * variance**2 / (runs - 1)
    )
    return tuple(chains_disagreement(more=centre - log_estimate, allowed=half))


def log_pool_weight(own: Pool, pool: Pool) -> FloatArray:
    """Log weights ``[N]`` of other rollouts, had the pool's proposals drawn them in its shares."""
    shares = log_shares(np.bincount(pool.component, minlength=own.log_ratio.shape[1]))
    return -np.asarray(log_sum_exp(own.log_ratio + shares, axis=1))


def pool_under(scored: ScoredRollouts, proposals: Sequence[FittedMoves], terms: Terms) -> Pool:
    """The pool of rollouts that none of its proposals drew."""
    component = np.zeros(scored.rollouts.count, dtype=np.int64)
    return pool_of(scored, component, proposals, terms)
