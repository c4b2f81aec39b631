"""Failure modes that Markov chains find before proposals are fitted.

A proposal is fitted to violations that were met, and what was never met shows neither in weights
nor in what is computed from them. Where rollouts begin at random or noise enters at each step,
violations may lie on several sides of what is likely. So chains that know no proposal search first
(:mod:`pemviz.sampling.subset.exploring`). Their violations follow the model where it violates: what
a proposal is to be (Chan, Kroese 2012 fit it to such chains). One is fitted for each failure mode
that they tell apart, and these keep a share of every stage. The chains' violations are not part
of the estimate.

They check it. With w = p / q of the pool's mixture q and m = E[w | violates], rollouts of q vary by
mu m - mu^2: where q hardly samples what the chains have found, m is large, whatever the weights of
rollouts of q say. And the chains' own estimates of mu have no bias. That they find less says
nothing against an average of weights, which overlooks and does not invent; finding more does.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from pemviz.arrays import FloatArray, log_sum_exp
from pemviz.proposals.offset_logistic import PolynomialBasis
from pemviz.sampling.estimates.diagnostics import (
    chains_disagreement,
    hardly_sampled,
)
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.mixture.balance_heuristic import FittedMoves, Pool, log_shares
from pemviz.sampling.mixture.fit import (
    HIDDEN_LEAST_SCATTER,
    HIDDEN_PRICE,
    Fit,
    FitSettings,
    fits_to_failures,
)
from pemviz.sampling.mixture.pooling import Terms, error_model, pool_of
from pemviz.sampling.mixture.surrogate import LearnedOnSurrogate
from pemviz.sampling.subset.exploring import Explored
from pemviz.types import Diagnostic, Estimate, ScoredRollouts

SHARE = 0.25
"""Of a stage's rollouts that are not exploration proposals, sampled from the chains' proposals."""
SURROGATE_SHARE, LATER_SHARE = 0.5, 0.25
"""Of the second stage's rollouts that are not exploration proposals, sampled from the surrogate's,
and of every later one's, as long as the surrogate's probability is near the simulator's."""
NEAR = 1.0
"""In decades; farther apart, they are systems that fail in other ways."""
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
    model = error_model(explored.scored.rollouts, terms)
    pool = _pool(explored.scored, (model,), terms)
    # what they count as under the error model, in place of a likelihood ratio
    # all count alike: by what its run found, one run's would hide the modes that others met
    pool = replace(pool, log_ratio=np.zeros_like(pool.log_ratio))
    return tuple(
        fits_to_failures(
            pool, basis, settings, least_scatter=HIDDEN_LEAST_SCATTER, price=HIDDEN_PRICE
        )
    )


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
    explored: Explored, pool: Pool, estimate: Estimate, *, terms: Terms
) -> tuple[Diagnostic, ...]:
    """What is wrong with an estimate beside what chains found."""
    if estimate.probability == 0.0 or estimate.std_error is None:
        return ()
    log_estimate = math.log(10.0) * (estimate.log10_probability or 0.0)
    totals = () if pool.rule else _totals(explored.log_probability, log_estimate)
    if explored.scored is None:
        return totals
    own = _pool(explored.scored, pool.proposals, terms)
    own = own.under_rule(pool.rule) if pool.rule else own
    violated = own.violated
    if not violated.any():
        return totals
    shares = log_shares(np.bincount(pool.component, minlength=own.log_ratio.shape[1]))
    log_q = np.asarray(log_sum_exp(own.log_ratio[violated] + shares, axis=1))
    log_p = explored.log_weight[violated]
    log_moment = log_sum(log_p - log_q) - log_sum(log_p)
    excess = max(math.expm1(min(log_moment - log_estimate, MOST_NATS)), 0.0)
    hardly = hardly_sampled(
        by_chains=math.sqrt(excess / pool.sampled),
        by_weights=estimate.std_error / estimate.probability,
    )
    return (*totals, *hardly)


def _totals(log_probability: FloatArray, log_estimate: float) -> tuple[Diagnostic, ...]:
    """Runs whose logarithms are about normal tell the log of their mean's interval."""
    runs = log_probability.size
    if not np.isfinite(log_probability).all():
        return ()
    variance = float(np.var(log_probability, ddof=1))
    centre = float(np.mean(log_probability)) + 0.5 * variance
    half = float(stdtrit(runs - 1, LEVEL)) * math.sqrt(
        variance / runs + 0.5 * variance**2 / (runs - 1)
    )
    return tuple(chains_disagreement(more=centre - log_estimate, allowed=half))


def _pool(scored: ScoredRollouts, proposals: Sequence[FittedMoves], terms: Terms) -> Pool:
    component = np.zeros(scored.rollouts.count, dtype=np.int64)
    return pool_of(scored, component, proposals, terms)
