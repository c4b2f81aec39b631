"""A stage's rollouts, drawn from what the state of a repetition says."""

from dataclasses import replace

import numpy as np

from pemviz.arrays import IntArray
from pemviz.proposals.defensive_share import share_for
from pemviz.proposals.latent_pilots import LatentFamily
from pemviz.proposals.offset_logistic import OffsetLogisticProposal
from pemviz.proposals.pilots import PilotFamily
from pemviz.sampling.mixture.aims import Aims
from pemviz.sampling.mixture.draws import PILOTS, divided
from pemviz.sampling.mixture.latents import divided_latents
from pemviz.sampling.mixture.state import MixtureState
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.zero_variance.method import with_latch
from pemviz.simulators.latched import VIOLATED, EachRule, MonitoredSimulator
from pemviz.simulators.latents import latent_counts
from pemviz.types import ScoredRollouts

DEFENSIVE_STEPS = 2.0
"""Of each rollout, drawn from the error model on average."""


def until_settled(problem: Problem) -> Problem:
    """The problem on a simulator that remembers what is broken, and that nothing is left to be."""
    rules = several_rules(problem)
    if not rules:
        return with_latch(problem)
    each = EachRule({rule: problem.rules[rule].monitor for rule in rules})
    return replace(problem, simulator=MonitoredSimulator(problem.simulator, each))


def several_rules(problem: Problem) -> tuple[str, ...]:
    """Their names; empty where there are not several."""
    return tuple(problem.rules) if len(problem.rules) > 1 else ()


def main_proposal(state: MixtureState, *, steps: int) -> OffsetLogisticProposal | None:
    """The main proposal that is drawn from next; ``None`` before the first stage."""
    if state.basis is None:
        return None
    return OffsetLogisticProposal(
        features=state.features,
        basis=state.basis,
        coefficients=state.fits[0].coefficients,
        violated=VIOLATED,
        defensive=defence(steps),
        means=state.fits[0].means,
    )


def drawn(
    problem: Problem,
    state: MixtureState,
    component: IntArray,
    *,
    seeds: np.random.SeedSequence,
) -> ScoredRollouts:
    """Rollouts drawn from given components, ascending, ``[N]``, and scored.

    Raises:
        SimulationError: A batch has something that is no finite number, or takes too long.
    """
    steps = problem.simulator.states - 1
    fitted = np.unique(component[component != PILOTS])
    generator = np.random.default_rng(seeds.spawn(1)[0])
    fits = [None if c == PILOTS else state.fits[c - fitted[0]] for c in component.tolist()]
    aims = Aims.of(state.rules, [fit.rule if fit else None for fit in fits])
    proposal = divided(
        component,
        {int(index): state.fits[index - fitted[0]].coefficients for index in fitted},
        main_proposal(state, steps=steps),
        aims=aims,
        family=PilotFamily.over(steps, turns=state.turns),
        features=state.features,
        generator=generator,
    )
    counts = latent_counts(problem.simulator)
    if counts:
        family = LatentFamily.over(steps // state.turns, start=counts.start, noise=counts.noise)
        pilots = family.drawn(int((component == PILOTS).sum()), generator, of=component.size)
        latents = divided_latents(
            pilots,
            [fit.means if fit else None for fit in fits],
            aims,
            counts,
            features=state.features,
            basis=state.basis,
            steps=steps // state.turns,
            turns=state.turns,
        )
        proposal = replace(proposal, latents=latents)
    return sample(problem, proposal=proposal, count=component.size, seeds=seeds)


def defence(steps: int) -> float:
    """Share of the error model in every outcome's probability, for rollouts of ``steps``."""
    return share_for(drawn_steps=DEFENSIVE_STEPS, steps=steps)
