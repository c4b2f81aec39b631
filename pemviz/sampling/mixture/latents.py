"""Latents in the mixture: what they are drawn from, and what proposals are fitted to."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray
from pemviz.latents import LatentCounts
from pemviz.proposals.latent_decisions import LatentDecisions
from pemviz.proposals.latent_means import (
    LatentMeans,
    choice_logit,
    noise_means,
    unmoved,
)
from pemviz.proposals.latent_pilots import LatentFamily, LatentPilots
from pemviz.proposals.offset_logistic import PolynomialBasis, StateFeatures
from pemviz.proposals.single_moves import even_logit
from pemviz.proposals.start_moves import StartMoves
from pemviz.sampling.mixture.aims import Aims, Rule, both, broken_at, still_open
from pemviz.sampling.mixture.monomials import Monomials, some_at_once
from pemviz.simulators.latched import VIOLATED
from pemviz.types import RolloutBatch, StateBatch

NOISE_DEGREE = 2
"""Of the polynomial that gives means of noise."""


@dataclass(frozen=True, eq=False)
class DividedLatents:
    """What the latents of each of N rollouts are drawn from: a pilot's means or fitted ones.

    Attributes:
        pilots: Of all N rollouts; 0 for those that are not pilots.
        start: Fitted moves at the start, of each rollout its own, none for pilots.
        noise: Fitted coefficients, ``[N, M, B]``, likewise.
        choice: Fitted coefficients of how often it is moved, ``[N, B]``.
        noise_sd: Spreads of half of the noise that is moved, ``[N, M]``, 1 for pilots.
        once: Which move one step's noise at most, ``[N]``.
        piloted: Which are pilots, ``[N]``: what they move, they move always.
        aims: The rule that each is to break, and until when it moves anything.
        features: What fitted proposals look at, beside the step's last outcome.
        basis: Monomials of it all; ``None`` if all rollouts are pilots.
        steps: Of a rollout.
        turns: Outcomes of a step.
    """

    pilots: LatentPilots
    start: StartMoves
    noise: FloatArray
    choice: FloatArray
    noise_sd: FloatArray
    once: BoolArray
    piloted: BoolArray
    aims: Aims
    features: StateFeatures
    basis: PolynomialBasis | None
    steps: int
    turns: int

    def start_mean(self) -> FloatArray:
        """Of the latents at the start, ``[N, S]``."""
        return self.pilots.start + self.start.mean

    def noise_mean(self, states: StateBatch, detected: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Of a step's noise: means ``[N, M]`` and shares ``[N]``, 0 after a violation."""
        step = int(states.step) // self.turns
        mean = self.pilots.noise_mean(step)
        share = np.ones(len(mean))
        if self.basis is not None:
            basis = self.basis.evaluate(_looked_at(self.features, states, detected))
            mean = mean + noise_means(basis, self.noise)
            logit = choice_logit(basis, self.choice)
            even = even_logit(np.array(step), steps=self.steps)
            share = expit(np.where(self.once, logit + even, logit))
            share = np.where(self.piloted, 1.0, share)
        over = states.memory.get(VIOLATED, np.zeros(len(mean), dtype=np.bool_))
        over = over | self.aims.reached(states.memory)
        return np.where(over[:, None], 0.0, mean), np.where(over, 0.0, share)

    def rows(self, rows: slice) -> "DividedLatents":
        """Of some of the rollouts."""
        return replace(
            self,
            pilots=self.pilots.rows(rows),
            start=self.start.rows(rows),
            noise=self.noise[rows],
            choice=self.choice[rows],
            noise_sd=self.noise_sd[rows],
            once=self.once[rows],
            piloted=self.piloted[rows],
            aims=self.aims.rows(rows),
        )


def divided_latents(
    pilots: LatentPilots,
    means: Sequence[LatentMeans | None],
    aims: Aims,
    counts: LatentCounts,
    *,
    features: StateFeatures,
    basis: PolynomialBasis | None,
    steps: int,
    turns: int,
) -> DividedLatents:
    """Of N rollouts.

    Args:
        pilots: Of all; 0 for those that are not pilots.
        means: Fitted ones of each rollout, ``None`` for pilots.
        aims: The rule that each is to break.
        counts: Latents of a rollout.
        features: What fitted proposals look at.
        basis: Monomials of it, for outcomes.
        steps: Of a rollout.
        turns: Outcomes of a step.
    """
    basis = None if basis is None else noise_basis(basis)
    monomials = 1 if basis is None else len(basis.exponents)
    none = unmoved(start=counts.start, noise=counts.noise, basis=monomials)
    own = [none if each is None else each for each in means]
    return DividedLatents(
        pilots=pilots,
        start=StartMoves.of_each([each.start for each in own]),
        noise=np.stack([each.noise for each in own]),
        choice=np.stack([each.choice for each in own]),
        noise_sd=np.stack([each.sd for each in own]),
        once=np.array([each.once for each in own]),
        piloted=np.array([each is None for each in means]),
        aims=aims,
        features=features,
        basis=basis,
        steps=steps,
        turns=turns,
    )


@dataclass(frozen=True, eq=False)
class FreshLatents:
    """Latents of rollouts that come to the pool.

    Attributes:
        decisions: As proposals see them.
        by_pilots: Log of the pilots' density over the model's, ``[n]``, under all rules together
            and each of several.
    """

    decisions: LatentDecisions
    by_pilots: Sequence[FloatArray]


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
    values, own = _looked_at(features, states, detected)[acts], noise_basis(basis)
    return FreshLatents(
        decisions=LatentDecisions(
            start=start,
            rollout=np.nonzero(acts)[0].astype(np.int64),
            monomials=Monomials(values, own) if many else own.evaluate(values),
            noise=latents.noise[acts],
            even=even_logit(np.nonzero(acts)[1], steps=acts.shape[1]),
            broken=None if broken is None else broken[acts],
        ),
        by_pilots=[
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


def noise_basis(basis: PolynomialBasis) -> PolynomialBasis:
    """Monomials for the means of noise, of what outcomes look at and of the outcome itself.

    A step's noise is drawn after its outcomes: an error of a position may matter with a detection
    alone.
    """
    return PolynomialBasis(
        mean=np.append(basis.mean, 0.5),
        spread=np.append(basis.spread, 0.5),
        degree=min(basis.degree, NOISE_DEGREE),
    )


def _looked_at(features: StateFeatures, states: StateBatch, detected: BoolArray) -> FloatArray:
    """Features of states ``[...]`` and outcomes there, ``[..., D + 1]``."""
    values = features.values(states)
    values = np.broadcast_to(values, (*detected.shape, values.shape[-1]))
    return np.concatenate([values, detected[..., None]], axis=-1, dtype=np.float64)


def latent_ratios(
    latents: LatentDecisions,
    moves: Sequence[tuple[LatentMeans, Rule]],
    *,
    rules: Sequence[str] = (),
    under: Rule = None,
) -> FloatArray:
    """Log q_k / p ``[N, K]`` of the latents of N rollouts under fitted proposals.

    Args:
        latents: The rollouts'.
        moves: Means of each proposal, and the rule that it is to break.
        rules: Names of those that are told apart.
        under: Until when rollouts are judged.
    """
    if not latents.is_made:
        edges = itertools.pairwise(some_at_once(latents.count))
        pieces = (latents.between(*pair) for pair in edges)
        return np.vstack([latent_ratios(few, moves, rules=rules, under=under) for few in pieces])
    found = np.zeros((latents.count, len(moves)))
    until = still_open(latents.broken, rules, under)
    for rule in dict.fromkeys(rule for _, rule in moves):
        own = still_open(latents.broken, rules, rule) if rule else None
        counted = latents.where(both(until, own))
        for column, (means, of) in enumerate(moves):
            if of == rule:
                found[:, column] = means.log_ratio(counted)
    return found


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
