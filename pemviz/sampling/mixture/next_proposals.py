"""What the next stage draws from beside the broad family: for each rule, and for what is unknown.

Among them are failure modes that the proposals fitted to all violations would hardly draw.
Such a mode looks improbable at first, because the broad proposals that met it missed more often
than needed: it is learned about on its own before the weights pass judgement on it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, log_sum_exp
from pemviz.proposals.latent_means import fit_means
from pemviz.proposals.offset_logistic import PolynomialBasis
from pemviz.proposals.offset_logistic_fit import fit_offset_logistic
from pemviz.sampling.elite_threshold import VIOLATION_THRESHOLD
from pemviz.sampling.estimates.importance_weights import effective_sample_size, log_sum
from pemviz.sampling.mixture.balance_heuristic import Pool, log_ratios
from pemviz.sampling.mixture.failure_modes import (
    SAMPLE,
    FailureModes,
    WeightedRollouts,
    failure_modes_of,
)
from pemviz.sampling.mixture.fit import (
    Elites,
    Fit,
    FitSettings,
    fit_blindly,
    fit_to_failures,
    fit_to_level,
    fitted,
    learned_from,
    noise_ridge,
    ridge_by_degree,
    smoothing_exponent,
    weights_of,
    with_exploring,
)

RELEVANT_SHARE = 1e-3
"""Of the estimate, from a hidden failure mode that is explored in every stage that learns."""
HARDLY_DRAWN = 3.0
"""Log of how many times more often exploration proposals draw a rollout than the main proposals
do."""
EVEN_SHARE = 0.9
"""Of the violating rollouts, which they count as where failure modes are told apart."""
LEAST_SCATTER, PRICE = 2.0, 0.3
KNOWN_ESS = 10.0
"""A failure mode is explored until its weights have this effective sample size."""
FEW_ELITES = 3


def next_proposals(
    pool: Pool,
    basis: PolynomialBasis,
    settings: FitSettings,
    *,
    defensive: float,
    explores: bool,
    for_final: bool,
) -> tuple[Fit, ...]:
    """With their shares of the rollouts that do not explore, the main proposals first.

    Rules that nothing has broken yet, beside others that something has, are searched for like
    hidden failure modes: a share of the rollouts goes towards them, and none of the final batch.

    Args:
        pool: What is learned from.
        basis: Monomials.
        settings: How.
        defensive: Share of the error model in every outcome's probability.
        explores: Whether the stage is one of the first.
        for_final: Whether the final batch is drawn from them.
    """
    pools = pool.each_rule()
    met = [one for one in pools if one.violated.any()] or pools
    main = tuple(
        replace(fit, share=fit.share / len(met))
        for one in met
        for fit in fit_to_failures(one, basis, settings)
    )
    hidden = [
        fit
        for one in met
        for fit in fit_to_hidden_ways(
            one,
            basis,
            settings,
            main=main,
            defensive=defensive,
            least_share=0.0 if explores else RELEVANT_SHARE,
        )
    ]
    level = [fit for one in pools if explores for fit in fit_to_level(one, basis, settings)]
    unmet = [] if for_final or len(met) == len(pools) else _towards(pools, basis, settings)
    blind = [fit for one in met for fit in fit_blindly(one, basis, settings)]
    return with_exploring(main, hidden, blind, [*unmet, *level])


def _towards(pools: Sequence[Pool], basis: PolynomialBasis, settings: FitSettings) -> list[Fit]:
    """Proposals for the least robust rollouts under rules that nothing has broken."""
    unmet = [one for one in pools if not one.violated.any()]
    return [fit for one in unmet for fit in fit_to_failures(one, basis, settings)]


def fit_to_hidden_ways(
    pool: Pool,
    basis: PolynomialBasis,
    settings: FitSettings,
    *,
    main: Sequence[Fit],
    defensive: float,
    least_share: float = 0.0,
) -> tuple[Fit, ...]:
    """A proposal for each failure mode that the ``main`` proposals would hardly draw.

    Ways are told apart by their chains of outcomes, nearly without weights.

    Args:
        pool: What is learned from.
        basis: Monomials.
        settings: How.
        main: The proposals fitted to all violations.
        defensive: Share of the error model in every outcome's probability.
        least_share: Ways that carry less of the estimate are left out.
    """
    hidden = Elites(VIOLATION_THRESHOLD, _hardly_drawn(pool, main, defensive))
    if hidden.count == 0:
        return ()
    log_weight = pool.log_weight[hidden.chosen]
    even = smoothing_exponent(log_weight, least_ess=EVEN_SHARE * hidden.count)
    weight = weights_of(pool, hidden, exponent=even)
    learned, rollouts = learned_from(pool, weight), np.flatnonzero(weight > 0.0)
    modes = _told_apart(learned.resampled(SAMPLE), basis, settings, varied=pool.varied)
    fits: list[Fit] = []
    for share in modes.responsibilities(learned).T:
        chosen = np.zeros_like(hidden.chosen)
        chosen[rollouts[share > 0.5]] = True
        own = Elites(VIOLATION_THRESHOLD, chosen)
        if not own.count or _share(pool, chosen) < least_share:
            continue
        if effective_sample_size(pool.log_weight[chosen]) <= KNOWN_ESS:
            aim = min(max(FEW_ELITES, settings.ess_share * own.count), own.count / 2)
            exponent = smoothing_exponent(pool.log_weight[chosen], least_ess=aim)
            fits.append(
                fitted(pool, basis, own, weights_of(pool, own, exponent=exponent), settings)
            )
    return tuple(fits)


def _told_apart(
    few: WeightedRollouts, basis: PolynomialBasis, settings: FitSettings, *, varied: bool
) -> FailureModes:
    """Failure modes among few rollouts."""
    ridge, of_noise = (
        ridge_by_degree(basis, settings.ridge, varied=varied),
        noise_ridge(basis, settings),
    )
    first = fit_offset_logistic(few.outcomes, ridge=ridge, start=np.zeros(ridge.size))
    means = None
    if few.latents is not None:
        means = fit_means(few.latents, few.weight, ridge=of_noise).means
    return failure_modes_of(
        few,
        first.coefficients,
        means=means,
        ridge=ridge,
        noise_ridge=of_noise,
        least_scatter=LEAST_SCATTER,
        price=PRICE,
    )


def _share(pool: Pool, chosen: BoolArray) -> float:
    """Of the estimate, from the ``chosen`` of the violating rollouts."""
    return float(np.exp(log_sum(pool.log_weight[chosen]) - log_sum(pool.log_weight[pool.violated])))


def _hardly_drawn(pool: Pool, main: Sequence[Fit], defensive: float) -> BoolArray:
    """Violating rollouts that exploration draws far more often than the main proposals, ``[N]``."""
    (ratio,) = log_ratios(
        pool.decisions,
        [fit.moves for fit in main],
        count=pool.count,
        defensive=defensive,
        rules=pool.rules,
        under=(pool.rule,),
        latents=pool.latents,
    )
    by_main: FloatArray = np.asarray(
        log_sum_exp(ratio + np.log([fit.share for fit in main]), axis=1)
    )
    return pool.violated & (pool.log_ratio[:, 0] - by_main > HARDLY_DRAWN)
