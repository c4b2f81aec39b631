"""What the next stage draws from beside pilots: proposals for each rule and for what is unknown."""

from collections.abc import Sequence
from dataclasses import replace

from pemviz.proposals.offset_logistic import PolynomialBasis
from pemviz.sampling.mixture.balance_heuristic import Pool
from pemviz.sampling.mixture.fit import (
    Fit,
    FitSettings,
    fit_blindly,
    fit_to_failures,
    fit_to_level,
    with_exploring,
)
from pemviz.sampling.mixture.hidden import fit_to_hidden_ways

RELEVANT_SHARE = 1e-3
"""Of the estimate, from a hidden failure mode that is explored in every stage that learns."""


def next_proposals(
    pool: Pool,
    basis: PolynomialBasis,
    settings: FitSettings,
    *,
    defensive: float,
    explores: bool,
    for_final: bool,
) -> tuple[Fit, ...]:
    """With their shares of the rollouts that are not pilots, the main proposals first.

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
