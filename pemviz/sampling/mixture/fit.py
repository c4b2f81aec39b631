"""Which rollouts a stage learns from, how much each counts, and the proposals fitted to them.

Of each rule there are proposals fitted to its violations; where it is a conjunction
(:func:`pemviz.stl.conjuncts`), of each conjunct, as a rare one's would count for nothing among all.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray, IntArray, at_most
from pemviz.proposals.defensive import LARGEST_SHARE
from pemviz.proposals.latent_moves import LatentMeans
from pemviz.proposals.latent_moves_fit import fit_means
from pemviz.proposals.offset_logistic import PolynomialBasis
from pemviz.proposals.offset_logistic_fit import (
    LogisticFit,
    WeightedOutcomes,
    fit_offset_logistic,
    leave_one_out_loss,
)
from pemviz.proposals.step_offsets import fit_step_offsets
from pemviz.sampling.estimates.importance_weights import smoothed_weights
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size
from pemviz.sampling.method import VIOLATION_THRESHOLD
from pemviz.sampling.mixture.balance_heuristic import FittedMoves, Pool, Rule
from pemviz.sampling.mixture.failure_modes import (
    LEAST_SCATTER,
    WeightedRollouts,
    failure_modes_of,
    shares_of_rollouts,
)
from pemviz.sampling.subset.rejuvenation import HALF

NEGLIGIBLE_SHARE = 1e-4
ESS_SHARE = 0.1
"""Weights are smoothed until their effective sample size is this share of the elites'."""
MOST_LEARNED = 2_000
"""Rollouts that a proposal is fitted to: of more, drawn by their weights. Every decision of theirs
takes its monomials' memory several times over, and time, and B coefficients that are fitted to n
rollouts tell them B / 2n nats short of the best: a fortieth at most by then."""
NOISE_RIDGE = {"constant": 0.01, "outcome": 0.5, "state": 50.0}
"""Penalties of coefficients of noise, relative to those of outcomes: of the constant, of the step's
own outcome, and of the state, each further degree twice as much. A few violations at some steps say
little of noise at the others: what they suggest must not keep later rollouts away from those."""
LEVERAGE_RIDGE = 0.1
"""Beside the weights of rollouts, so that no fit rests on one alone."""
STATE_RIDGES = (1.0, 7.0, 50.0)
"""Times the penalties of outcomes' coefficients of the state where steps have noise. Which steps a
few violations had their error at says little of the others; the likelihood of rollouts that were
left out chooses."""
BLIND = 1e6
"""Times these penalties where a proposal is not to look at the state."""
FEW_FEATURES = 3
EXPLORING_SHARE = 0.25
"""Of the rollouts that are not exploration proposals, for a level above 0, for failure modes whose
share is not known, and for what is blind to the state."""
LEAST_GAIN = 1.0
"""By so much likelier violations that were left out must be for proposals that look at the step
alone, or are fitted to each known mode's [nats a rollout]."""
BY_STATE_SHARE = 0.5
"""Of the rollouts of a mode where a proposal that looks at the step alone is nearer."""
LARGEST_LEVEL = 0.5
"""Of the probability under the error model that elites have between them."""
WIDE_SHARE = 0.25
"""Of a main proposal's rollouts, sampled with a larger share of the error model."""
FEW_STEPS, WIDEST, WIDEST_SHARE = 8.0, 0.3, 0.5
"""Where rollouts all start alike and main proposals leave the error model in fewer steps than
these, the share of the error model, and of the rollouts that take it: over few steps a large one
hardly makes failures rarer, and one detection more is a large part of such a chain."""


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """How proposals are fitted.

    Attributes:
        elites: Fewer violating rollouts than this, and the level is raised until there are.
        ridge: Penalty of the coefficients of degree 1; each further degree doubles it.
        alpha: Exponent of the weights; ``None``: by their effective sample size.
        sigma: Elites of a level above 0 are 1 - sigma of the rollouts, and ``elites`` at least.
        independent: As how large a share of the rollouts so many independent ones would tell as
            much.
    """

    elites: int = 10
    ridge: float = 0.3
    alpha: float | None = None
    sigma: float = 0.95
    independent: float = 1.0


@dataclass(frozen=True)
class Fit:
    """A fitted proposal.

    Attributes:
        coefficients: ``[B]``.
        optimism: By how much it overstates the log likelihood of each rollout of the pool it
            was fitted to, ``[N]`` [nats].
        of_outcomes: The part of it that is not of latents, ``[N]`` [nats].
        threshold: The level of robustness below which rollouts were learned from.
        elites: How many.
        loss: [nats a decision].
        share: Of the rollouts that are not exploration proposals, drawn from it.
        means: How it moves latents, where there are any.
        rule: Which it is to break.
        defensive: As :class:`FittedMoves` has it.
        departure: How far its probabilities of a miss are from the error model's, summed over the
            steps of a rollout that it learned from, on average.
        by_step: As :class:`FittedMoves` has it.
        log_likelihood: Of the outcomes that it learned from, each rollout left out of the fit once,
            by their weights [nats].
    """

    coefficients: FloatArray
    optimism: FloatArray
    of_outcomes: FloatArray
    threshold: float
    elites: int
    loss: float
    share: float = 1.0
    means: LatentMeans | None = None
    rule: Rule = None
    defensive: float | None = None
    departure: float = 0.0
    by_step: FloatArray | None = None
    log_likelihood: float = 0.0

    @property
    def is_short(self) -> bool:
        """Whether it leaves the error model for few steps."""
        return self.departure < FEW_STEPS

    @property
    def moves(self) -> FittedMoves:
        """How it leaves the error model."""
        return FittedMoves(self.coefficients, self.means, self.rule, self.defensive, self.by_step)


@dataclass(frozen=True)
class Elites:
    """The rollouts that a proposal learns from.

    Attributes:
        threshold: They violate, or their robustness is at most this level.
        chosen: Which of the pool's, ``[N]``.
    """

    threshold: float
    chosen: BoolArray

    @property
    def count(self) -> int:
        """How many."""
        return int(self.chosen.sum())


def next_proposals(
    pool: Pool,
    basis: PolynomialBasis,
    settings: FitSettings,
    *,
    defensive: float,
    unknown: Sequence[Fit],
    needed: Sequence[BoolArray],
    explores: bool,
    for_final: bool,
) -> tuple[Fit, ...]:
    """With their shares of the rollouts that do not explore, the main proposals first.

    Rules and conjuncts that nothing has broken yet, beside others that something has, are searched
    for: a share of the rollouts goes towards them, and none of the final batch.

    Args:
        pool: What is learned from.
        basis: Monomials.
        settings: How.
        defensive: Share of the error model in every outcome's probability.
        unknown: Proposals for failure modes whose share of the estimate the pool cannot tell; their
            own shares sum to 1.
        needed: Misses that rollouts of each known failure mode need, ``[n, T-1]``.
        explores: Whether the stage is one of the first.
        for_final: Whether the final batch is sampled from them.
    """
    pools = pool.each_target()
    met = [one for one in pools if one.violated.any()] or pools
    total = sum(one.share for one in met)
    main = [
        replace(fit, share=fit.share * one.share / total)
        for one in met
        for fit in fits_to_failures(one, basis, settings, needed=needed)
    ]
    hard = False
    if has_many_features(basis, defensive=defensive):
        alike = pool.latents is None or not pool.latents.start.shape[1]
        hard = alike and all(fit.is_short for fit in main)
        share, wide = (WIDEST_SHARE, WIDEST) if hard else (WIDE_SHARE, LARGEST_SHARE)
        main = [one for fit in main for one in _with_wide(fit, share=share, defensive=wide)]
    towards: list[Fit] = []
    if not for_final and len(met) < len(pools):
        unmet = [one for one in pools if not one.violated.any()]
        towards = [fit for one in unmet for fit in fits_to_failures(one, basis, settings)]
    if explores:
        towards += [fit for one in pools for fit in _fit_to_level(one, basis, settings)]
    blind = [fit for one in met for fit in _fit_blindly(one, basis, settings)]
    if hard:
        unknown = [replace(fit, defensive=WIDEST) for fit in unknown]
        towards = [replace(fit, defensive=WIDEST) for fit in towards]
    others = [fits for fits in (blind, towards) if fits]
    rest = 1.0 - EXPLORING_SHARE * (len(others) + bool(unknown))
    return (
        *(replace(fit, share=rest * fit.share) for fit in main),
        *(replace(fit, share=EXPLORING_SHARE * fit.share) for fit in unknown),
        *(replace(f, share=EXPLORING_SHARE / len(fits)) for fits in others for f in fits),
    )


def has_many_features(basis: PolynomialBasis, *, defensive: float) -> bool:
    """Whether proposals look at more than they learn reliably, where rollouts are long.

    In short ones the share of the error model, ``defensive``, is as large as any.
    """
    return basis.mean.size > FEW_FEATURES and defensive < LARGEST_SHARE


def fits_to_failures(
    pool: Pool,
    basis: PolynomialBasis,
    settings: FitSettings,
    *,
    needed: Sequence[BoolArray] = (),
    least_scatter: float = LEAST_SCATTER,
    price: float = 1.0,
) -> Sequence[Fit]:
    """The proposals nearest to the violating rollouts' distribution under the error model.

    One for each failure mode that the rollouts tell apart, the largest share first; how readily
    they are told apart is what :func:`failure_modes_of` takes. Or one for each mode that is known
    by the misses that rollouts of it need, ``needed``.
    """
    elites = failing_elites(pool.robustness, pool.violated, least=settings.elites)
    weight, exponent = smoothed(pool, elites, settings)
    first = fitted(pool, basis, elites, weight, settings)
    learned = _learned_from(pool, weight)
    modes = failure_modes_of(
        learned,
        first.coefficients,
        means=first.means,
        ridge=_ridge(basis, settings, varied=pool.varied),
        noise_ridge=_noise_ridge(basis, settings),
        least_scatter=least_scatter,
        price=price,
    )
    share, of_modes = modes.share, [(first, weight)]
    if share.size > 1:
        of_each = _smoothed_anew(pool, weight, exponent, modes.responsibilities(learned), settings)
        of_modes = [
            (fitted(pool, basis, elites, part, settings, start=start), part)
            for part, start in zip(of_each, modes.coefficients, strict=True)
        ]
    parts = [(_and_by_step(fit, pool, part), part) for fit, part in of_modes]
    apart = [
        (_and_by_step(fitted(pool, basis, elites, part, settings), pool, part), part)
        for part in _parts_by_misses(pool, weight, needed)
    ]
    total = float(weight.sum())
    if apart and _log_likelihood(apart) > _log_likelihood(parts) + LEAST_GAIN * total:
        share, parts = np.array([part.sum() for _, part in apart]) / total, apart
    return [
        replace(fit, share=own * fit.share)
        for (fits, _), own in zip(parts, shares_of_rollouts(share), strict=True)
        for fit in fits
    ]


def _smoothed_anew(
    pool: Pool, weight: FloatArray, exponent: float, own: FloatArray, settings: FitSettings
) -> Iterator[FloatArray]:
    """Weights ``[N]`` of each mode's, for one may have few where all together have many.

    ``own`` is how likely each rollout that is learned from is to be of each mode, ``[E, C]``.
    """
    log_weight = pool.log_weight[weight > 0.0]
    for of_mode in own.T:
        known = log_weight[of_mode > 0.5]
        if settings.alpha is None and known.size:
            least = _least_ess(known.size, _enough(pool, settings))
            exponent = min(exponent, smoothing_exponent(known, least_ess=least))
        log_part = exponent * log_weight + np.log(np.maximum(of_mode, np.finfo(float).tiny))
        part = np.zeros(pool.count)
        part[weight > 0.0] = smoothed_weights(log_part, alpha=1.0) * effective_sample_size(log_part)
        yield part


def _log_likelihood(parts: Sequence[tuple[Sequence[Fit], FloatArray]]) -> float:
    """Of rollouts that are each sampled from the proposal nearest to its part, by their weights."""
    total = sum(float(weight.sum()) for _, weight in parts)
    return sum(
        fits[0].log_likelihood + float(weight.sum()) * math.log(float(weight.sum()) / total)
        for fits, weight in parts
    )


def nearest_modes(pool: Pool, rows: IntArray, needed: Sequence[BoolArray]) -> IntArray:
    """The known mode that each of these rollouts has most misses of, ``[n]``.

    ``len(needed)``: less than half of what any rollout of any needs.
    """
    if not needed or not rows.size:
        return np.full(rows.size, len(needed), dtype=np.int64)
    decisions = pool.decisions
    row = np.searchsorted(rows, decisions.rollout).clip(0, rows.size - 1)
    missed = np.zeros((rows.size, pool.steps))
    of_these = decisions.missed & (rows[row] == decisions.rollout)
    missed[row[of_these], decisions.step[of_these]] = 1.0
    share = [((missed @ misses.T) / misses.sum(axis=1)).max(axis=1) for misses in needed]
    return np.where(np.max(share, axis=0) >= HALF, np.argmax(share, axis=0), len(needed))


def _parts_by_misses(
    pool: Pool, weight: FloatArray, needed: Sequence[BoolArray]
) -> Sequence[FloatArray]:
    """Weights ``[N]`` of what is in each known mode, and of all else, the largest first.

    Empty where nothing that is learned from is in any.
    """
    learned = np.flatnonzero(weight > 0.0)
    mode = nearest_modes(pool, learned, needed)
    if mode.min() == len(needed):
        return ()
    parts: list[FloatArray] = []
    for number in np.unique(mode):
        part = np.zeros(pool.count)
        part[learned[mode == number]] = weight[learned[mode == number]]
        parts.append(part)
    return sorted(parts, key=lambda part: -float(part.sum()))


def _with_wide(fit: Fit, *, share: float, defensive: float) -> Sequence[Fit]:
    """The proposal, and in part of its rollouts the same with a larger share of the error model.

    Chains of errors are learned from those that were met, and where these missed at every step of
    a stretch, chains with a detection among the misses, or after the last that matters, are sampled
    too seldom for their share of the probability: each such outcome makes a weight up to 1 / d
    times as large. With few features there are few coefficients, and enough rollouts for them.
    """
    return (
        replace(fit, share=(1.0 - share) * fit.share),
        replace(fit, share=share * fit.share, defensive=defensive),
    )


def _fit_blindly(pool: Pool, basis: PolynomialBasis, settings: FitSettings) -> Sequence[Fit]:
    """The same, blind to the state, where steps have noise; else empty.

    Where one error decides, the steps that the few first violations had theirs at are all that the
    others are fitted to. Steps that these would hardly move, and do not know of, this one moves.
    """
    if not pool.noisy:
        return ()
    elites = failing_elites(pool.robustness, pool.violated, least=settings.elites)
    weight, _ = smoothed(pool, elites, settings)
    return (fitted(pool, basis, elites, weight, settings, blind=True),)


def _fit_to_level(pool: Pool, basis: PolynomialBasis, settings: FitSettings) -> Sequence[Fit]:
    """The proposal nearest to what lies at or below a level of robustness above 0.

    The elites count, by their effective sample size, as the share 1 - sigma of the rollouts sampled
    so far. Empty where the weights tell the probability of every level down to 0.
    """
    exponent = 1.0 if settings.alpha is None else settings.alpha
    elites = guided_elites(
        pool.robustness,
        pool.violated,
        exponent * pool.log_weight,
        least_ess=max(settings.elites, (1.0 - settings.sigma) * pool.count),
    )
    if elites.threshold <= VIOLATION_THRESHOLD:
        return ()
    return (fitted(pool, basis, elites, _weights(pool, elites, exponent), settings),)


def fitted(
    pool: Pool,
    basis: PolynomialBasis,
    elites: Elites,
    weight: FloatArray,
    settings: FitSettings,
    *,
    start: FloatArray | None = None,
    blind: bool = False,
) -> Fit:
    """The proposal fitted to the pool's rollouts by their weights ``[N]``, ``blind`` to states."""
    outcomes, group, _ = _outcomes(pool, weight)
    if start is None:
        known = pool.proposals
        start = known[-1].coefficients if known else np.zeros(len(basis.exponents))
    plain = _ridge(basis, settings, varied=pool.varied)
    of_state = np.array([len(chosen) > 0 for chosen in basis.exponents])
    tried: list[tuple[float, LogisticFit, FloatArray]] = []
    for times in (BLIND,) if blind else STATE_RIDGES if pool.noisy else (1.0,):
        ridge = np.where(of_state, times * plain, plain)
        fit = fit_offset_logistic(outcomes, ridge=ridge, start=start)
        optimism = leave_one_out_loss(
            fit, group=group, count=weight.size, first_order=pool.latents is None
        )
        penalised = 0.5 * float(ridge @ fit.coefficients**2)
        likelihood = penalised - fit.loss * float(outcomes.weight.sum())
        # of rollouts each left out of the fit
        tried.append((likelihood - float(weight @ optimism), fit, optimism))
    log_likelihood, found, of_outcomes = max(tried, key=lambda one: one[0])
    means, optimism = None, of_outcomes
    if pool.latents is not None:
        of_noise = _noise_ridge(basis, settings, of_state=BLIND if blind else 1.0)
        latents = pool.latents.where(pool.open_noise)
        means, of_start, first_order = fit_means(
            latents, weight, ridge=of_noise, independent=settings.independent
        )
        # Where few rollouts carry the fit, of a mean fitted by least squares in which a rollout
        # has the share h: its residual e is e / (1 - h) without it, so that the square grows by
        # (2 h - h^2) / (1 - h)^2, not by 2 h
        share = weight / (weight.sum() + LEVERAGE_RIDGE)
        beyond_first_order = (1.0 - 0.5 * share) / (1.0 - share) ** 2
        optimism = optimism + of_start + first_order * beyond_first_order
    departs = np.abs(found.miss - expit(outcomes.offset))
    return Fit(
        coefficients=found.coefficients,
        optimism=optimism,
        of_outcomes=of_outcomes,
        means=means,
        threshold=elites.threshold,
        elites=elites.count,
        loss=found.loss,
        rule=pool.rule,
        departure=float(outcomes.weight @ departs) / float(weight.sum()),
        log_likelihood=log_likelihood,
    )


def _and_by_step(fit: Fit, pool: Pool, weight: FloatArray) -> Sequence[Fit]:
    """The proposal; before it one that looks at the step alone, where that is clearly nearer.

    A share of the rollouts stays with the proposal: what violates otherwise than most would have
    weights without bound if the step decided alone.
    """
    outcomes, group, step = _outcomes(pool, weight)
    found = fit_step_offsets(outcomes, step=step, steps=pool.steps, group=group, count=weight.size)
    if found.log_likelihood <= fit.log_likelihood + LEAST_GAIN * float(weight.sum()):
        return (fit,)
    departs = np.abs(found.miss - expit(outcomes.offset))
    by_step = replace(
        fit,
        coefficients=np.zeros_like(fit.coefficients),
        by_step=found.offsets,
        optimism=fit.optimism - fit.of_outcomes + found.optimism,
        of_outcomes=found.optimism,
        loss=found.loss,
        departure=float(outcomes.weight @ departs) / float(weight.sum()),
        log_likelihood=found.log_likelihood,
        share=1.0 - BY_STATE_SHARE,
    )
    return by_step, replace(fit, share=BY_STATE_SHARE)


def _outcomes(pool: Pool, weight: FloatArray) -> tuple[WeightedOutcomes, IntArray, IntArray]:
    """Those of rollouts whose weight ``[N]`` is not 0, until the rule is broken.

    And of which rollout each is, and which of its outcomes.
    """
    decisions = pool.decisions
    kept = weight[decisions.rollout] > 0.0
    if pool.open is not None:
        kept &= pool.open
    group = decisions.rollout[kept]
    outcomes = WeightedOutcomes(
        basis=decisions.basis[kept],
        missed=decisions.missed[kept],
        offset=decisions.offset[kept],
        weight=weight[group],
    )
    return outcomes, group, decisions.step[kept]


def _learned_from(pool: Pool, weight: FloatArray) -> WeightedRollouts:
    """Those of the pool's rollouts whose weight ``[N]`` is not 0."""
    outcomes, group, _ = _outcomes(pool, weight)
    number = np.cumsum(weight > 0.0) - 1
    latents = pool.latents
    if latents is not None:
        latents = latents.where(pool.open_noise).of(np.flatnonzero(weight > 0.0))
    rollout = number[group].astype(np.int64)
    return WeightedRollouts(outcomes, rollout, weight[weight > 0.0], latents)


def smoothed(pool: Pool, elites: Elites, settings: FitSettings) -> tuple[FloatArray, float]:
    """Weights ``[N]`` of the pool's rollouts, and the exponent that they are smoothed by."""
    exponent = settings.alpha
    if exponent is None:
        least = _least_ess(elites.count, _enough(pool, settings))
        exponent = smoothing_exponent(pool.log_weight[elites.chosen], least_ess=least)
    return _weights(pool, elites, exponent), exponent


def _enough(pool: Pool, settings: FitSettings) -> int:
    """Effective sample size of a fit: as many rollouts as there are means of starts at least."""
    starts = 0 if pool.latents is None else pool.latents.start.shape[1]
    return max(settings.elites, starts)


def _least_ess(count: int, elites: int) -> float:
    return float(min(max(elites, ESS_SHARE * count), count / 2))


def _weights(pool: Pool, elites: Elites, exponent: float) -> FloatArray:
    """Of the pool's rollouts, ``[N]``; they sum to their effective sample size.

    Of very many elites some stand for the others, see :func:`at_most`.
    """
    log_weight = pool.log_weight[elites.chosen]
    smooth = smoothed_weights(log_weight, alpha=exponent)
    weight = np.zeros(pool.count)
    weight[elites.chosen] = smooth * effective_sample_size(exponent * log_weight)
    weight[weight < NEGLIGIBLE_SHARE * weight.max()] = 0.0
    return at_most(weight, MOST_LEARNED)


def smoothing_exponent(log_weight: FloatArray, *, least_ess: float) -> float:
    """Largest exponent in [0, 1] that leaves weights ``[M]`` the wanted effective sample size."""
    from scipy.optimize import brentq  # noqa: PLC0415  slow to import

    relative = log_weight - np.max(log_weight)

    def excess(exponent: float) -> float:
        weight = np.exp(exponent * relative)
        return float(weight.sum() ** 2 / (weight @ weight)) - least_ess

    if excess(1.0) >= 0.0:
        return 1.0
    if excess(0.0) <= 0.0:
        return 0.0
    return float(cast(float, brentq(excess, 0.0, 1.0, xtol=1e-6)))


def _noise_ridge(
    basis: PolynomialBasis, settings: FitSettings, *, of_state: float = 1.0
) -> FloatArray:
    """Penalties of the coefficients of noise, ``[B']``; those of the state times ``of_state``."""
    outcome = (basis.mean.size,)
    alone: dict[tuple[int, ...], float] = {
        (): NOISE_RIDGE["constant"],
        outcome: NOISE_RIDGE["outcome"],
    }
    relative = [
        alone.get(chosen, of_state * NOISE_RIDGE["state"] * 2.0 ** (len(chosen) - 1))
        for chosen in basis.with_outcome().exponents
    ]
    return settings.ridge * np.array(relative)


def _ridge(basis: PolynomialBasis, settings: FitSettings, *, varied: bool) -> FloatArray:
    """Penalties ``[B]``: the constant's a tenth, each degree beyond the first twice as much.

    The more monomials of D features, the more ways to follow what the few rollouts that count
    happened to do, and the farther off lie the others, whose weights then carry the estimate: more
    so where rollouts start at several random values, are ``varied``, and spread over all features.
    Penalties of degree k are (D / 3)^(2 + k) times as much, (D / 3)^(4 + k) where varied, beyond
    three features. The exponents were found on a cart pole with eight and on encounters with six,
    against violations that plain simulation had met.
    """
    degrees = np.array([len(chosen) for chosen in basis.exponents])
    more = max(1.0, basis.mean.size / FEW_FEATURES)
    of_state = 2.0 ** (degrees - 1.0) * more ** (degrees + (4.0 if varied else 2.0))
    return settings.ridge * np.where(degrees == 0, 0.1, of_state)


def failing_elites(robustness: FloatArray, violated: BoolArray, *, least: int) -> Elites:
    """The violating rollouts; with too few of them the least robust others as well.

    They are ``least`` at least, or a third of all ``[N]``.
    """
    least = min(least, max(1, violated.size // 3))
    if int(violated.sum()) >= least:
        return Elites(VIOLATION_THRESHOLD, violated)
    level = float(np.partition(robustness, least - 1)[least - 1])
    level = max(level, VIOLATION_THRESHOLD)
    return Elites(level, violated | (robustness <= level))


def guided_elites(
    robustness: FloatArray, violated: BoolArray, log_weight: FloatArray, *, least_ess: float
) -> Elites:
    """Rollouts down to the lowest level of robustness that the weights tell the probability of.

    The effective sample size of what lies at or below the level, and at or below any higher one,
    is ``least_ess`` at least. What fails in an improbable way, far below what is known well, does
    not draw the level down to 0.

    Robustness, verdicts and log weights, exponents included, are ``[N]``.
    """
    score = np.where(violated, np.minimum(robustness, VIOLATION_THRESHOLD), robustness)
    order = np.argsort(score, kind="stable")
    relative = np.exp(log_weight[order] - np.max(log_weight))
    total, squares = np.cumsum(relative), np.cumsum(relative**2)
    enough = np.square(total) >= least_ess * squares
    # ties count together: only the last of equal scores tells the level's effective sample size
    ordered = score[order]
    last = np.append(ordered[1:] > ordered[:-1], True)
    short = np.flatnonzero(last & ~enough & (ordered >= VIOLATION_THRESHOLD))
    above = ordered[min(short[-1] + 1, ordered.size - 1)] if short.size else VIOLATION_THRESHOLD
    level = max(float(above), VIOLATION_THRESHOLD)
    # where most rollouts share one score, the level lies below it
    few = ordered[last & (total <= LARGEST_LEVEL * total[-1])]
    if few.size and level > few[-1]:
        level = max(float(few[-1]), VIOLATION_THRESHOLD)
    return Elites(level, score <= level)
