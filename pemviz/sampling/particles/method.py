"""Independent runs of particles: levels are cut one after the other until particles violate.

Run r estimates mu_r as the product of the shares of particles that came below each level::

    mu = 1 / R sum_r mu_r, standard error: deviation of mu_1 .. mu_R over sqrt(R)

It needs no likelihood ratios: an independent check of the other methods.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.method import final_stage
from pemviz.sampling.particles.estimate import SHARED, columns_of, estimate_of_runs
from pemviz.sampling.particles.runs import ParticleRun
from pemviz.sampling.problem import FinishedStage, Problem
from pemviz.sampling.rollouts.large_stages import log_p_of
from pemviz.sampling.seeds import stage_seeds
from pemviz.types import Estimate, StageResult

RULE = "common_ancestry."


class Runs(Protocol):
    """Carries out independent runs that keep step: the scenario moves all particles at once.

    Attributes:
        moved_share: About how many of a run's particles are moved at a time, as a share of them.
    """

    moved_share: ClassVar[float]

    def prepare(
        self, problem: Problem, *, count: int, generator: np.random.Generator
    ) -> "tuple[Runs, int]":
        """What carries out runs of ``count`` particles, and how many rollouts finding it took."""
        ...

    def carry_out(
        self, problem: Problem, *, count: int, generators: Sequence[np.random.Generator]
    ) -> Sequence[ParticleRun]:
        """Runs of ``count`` particles, one for each of ``generators``; none depends on another."""
        ...


@dataclass(frozen=True)
class ParticleState:
    """Where a repetition stands.

    Attributes:
        repetition: Zero-based.
        runs: Those that are done.
        ahead: Those that were carried out with the last of them.
        prepared: What carries out the others; ``None`` before any is.
    """

    repetition: int
    runs: tuple[ParticleRun, ...] = ()
    ahead: tuple[ParticleRun, ...] = ()
    prepared: Runs | None = None


@dataclass(frozen=True, kw_only=True)
class ParticleSampling:
    """Independent runs, averaged.

    Attributes:
        name: ``splitting`` or ``subset``.
        of: How a run goes.
        stages: How many runs; at least five, for a standard error and an interval.
        rollouts: Particles in each.
        seed: Root of all randomness.
    """

    name: str
    of: Runs
    stages: int
    rollouts: int
    seed: int

    def init(self, problem: Problem, *, repetition: int) -> ParticleState:  # noqa: ARG002
        """Nothing is sampled yet."""
        return ParticleState(repetition=repetition)

    def step(self, problem: Problem, state: ParticleState) -> tuple[ParticleState, StageResult]:
        """Carry out one run, and with it as many as make up a batch of rollouts."""
        stage = len(state.runs)
        finished = problem.finished(state.repetition, stage)
        if finished is not None:
            run, ahead = _restored(finished), []
        elif state.ahead:
            run, *ahead = state.ahead
        else:
            state, (run, *ahead) = self._next_runs(problem, state)
        problem.progress(run.count, run.count)
        result = replace(
            final_stage(
                repetition=state.repetition,
                stage=stage,
                scored=run.scored,
                sampled_from=PemProposal(),
            ),
            probability=math.exp(run.log_probability),
            log10_probability=(
                run.log_probability / math.log(10.0) if run.log_probability > -math.inf else None
            ),
            ess=None,
            kept={
                **{name: np.array(getattr(run, name)) for name in ("log_probability", *SHARED)},
                **{f"{RULE}{n}": np.array(share) for n, share in run.rule_ancestry.items()},
            },
        )
        return replace(state, runs=(*state.runs, run), ahead=tuple(ahead)), result

    def _next_runs(
        self, problem: Problem, state: ParticleState
    ) -> tuple[ParticleState, Sequence[ParticleRun]]:
        """As many runs as make up a batch of rollouts, and what they were prepared by."""
        first, prepared, spent = len(state.runs), state.prepared, 0
        moved = max(self.rollouts * self.of.moved_share, 1.0)
        together = max(int(problem.batch_rollouts / moved), 1)
        own = self._generator(state, self.stages)
        if prepared is None:
            prepared, spent = self.of.prepare(problem, count=self.rollouts, generator=own)
        numbers = range(first, min(first + together, self.stages))
        generators = [self._generator(state, stage) for stage in numbers]
        run, *others = prepared.carry_out(problem, count=self.rollouts, generators=generators)
        if first == 0:
            run = replace(run, simulated=run.simulated + spent)
        return replace(state, prepared=prepared), (run, *others)

    def _generator(self, state: ParticleState, stage: int) -> np.random.Generator:
        return np.random.default_rng(
            stage_seeds(seed=self.seed, repetition=state.repetition, stage=stage)
        )

    def under_rule(self, state: ParticleState, rule: str) -> ParticleState:
        """The same particles with the verdict of one rule."""
        return replace(state, runs=tuple(run.under_rule(rule) for run in state.runs))

    def is_done(self, state: ParticleState) -> bool:
        """Whether all runs are done."""
        return len(state.runs) >= self.stages

    def estimate(self, state: ParticleState) -> Estimate:
        """The mean of the runs and the standard error between them.

        Raises:
            ValueError: No run is done yet.
        """
        if not state.runs:
            message = "no run is done yet"
            raise ValueError(message)
        return estimate_of_runs(state.runs, method=self.name)

    def kept_columns(self, state: ParticleState) -> Mapping[str, AnyArray]:
        """What each run's particles share."""
        return columns_of(state.runs)


def _restored(finished: FinishedStage) -> ParticleRun:
    """A run as an interrupted process left it."""
    scored, kept = finished.scored, finished.kept
    return ParticleRun(
        **{name: kept[name].item() for name in ("log_probability", *SHARED)},
        count=scored.rollouts.count,
        log_p=log_p_of(scored.rollouts, scored.violated),
        scored=scored,
        rule_ancestry={
            name.removeprefix(RULE): float(value)
            for name, value in kept.items()
            if name.startswith(RULE)
        },
    )
