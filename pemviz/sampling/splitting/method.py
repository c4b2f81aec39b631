"""Multilevel splitting: rollouts that come close are cut and continued, level by level.

Norden, O'Kelly, Sinha 2019 use it for black-box assessment of driving; the estimator is the
adaptive multilevel splitting of Brehier, Gazeau, Goudenege, Lelievre, Rousset 2016, which is
unbiased with ties. It needs no likelihood ratios: an independent check of the other methods.

N particles follow the error model. Level l is their median; the K_l of them that never came below
it are replaced by continuations of others, each from where it first came below. Levels fall until
the median violates, or none came below (then mu_r = 0). F of them violate in the end::

    run       mu_r = (F / N) prod_l (1 - K_l / N)
    estimate  mu   = 1 / R sum_r mu_r, standard error: deviation of mu_1 .. mu_R over sqrt(R)
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pemviz.arrays import BoolArray, row_sums
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.adaptive.elite_threshold import VIOLATION_THRESHOLD
from pemviz.sampling.estimates.diagnostics import run_diagnostics
from pemviz.sampling.estimates.estimate import log_normal_interval, negative_log_likelihood
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.method import final_stage, stage_seeds
from pemviz.sampling.problem import Problem, in_time, score
from pemviz.sampling.splitting.particles import (
    Particles,
    draw_particles,
    restarted,
)
from pemviz.types import Estimate, FinishedStage, ScoredRollouts, StageResult

KILLED_SHARE = 0.5
MOST_LEVELS = 10_000


@dataclass(frozen=True)
class SplittingRun:
    """One independent run.

    Attributes:
        log_probability: Its estimate; -inf if the particles died out.
        simulated: Rollouts begun or continued.
        levels: How often particles were cut.
        scored: The particles at the end.
    """

    log_probability: float
    simulated: int
    levels: int
    scored: ScoredRollouts


@dataclass(frozen=True)
class SplittingState:
    """The repetition and its runs so far."""

    repetition: int
    runs: tuple[SplittingRun, ...] = ()


@dataclass(frozen=True, kw_only=True)
class SplittingSampling:
    """Independent runs of adaptive multilevel splitting, averaged.

    Attributes:
        stages: How many runs; at least two, for a standard error.
        rollouts: Particles in each.
        seed: Root of all randomness.
    """

    stages: int
    rollouts: int
    seed: int
    name: str = "splitting"

    def init(self, problem: Problem, *, repetition: int) -> SplittingState:  # noqa: ARG002
        """Nothing is drawn yet."""
        return SplittingState(repetition=repetition)

    def step(self, problem: Problem, state: SplittingState) -> tuple[SplittingState, StageResult]:
        """Carry out one run."""
        stage = len(state.runs)
        finished = problem.finished(state.repetition, stage)
        if finished is None:
            seeds = stage_seeds(seed=self.seed, repetition=state.repetition, stage=stage)
            run = split(problem, count=self.rollouts, generator=np.random.default_rng(seeds))
        else:
            run = _restored(finished)
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
                "log_probability": np.array(run.log_probability),
                "simulated": np.array(run.simulated),
                "levels": np.array(run.levels),
            },
        )
        return replace(state, runs=(*state.runs, run)), result

    def is_done(self, state: SplittingState) -> bool:
        """Whether all runs are done."""
        return len(state.runs) >= self.stages

    def estimate(self, state: SplittingState) -> Estimate:
        """The mean of the runs and the standard error between them.

        Raises:
            ValueError: No run is done yet.
        """
        if not state.runs:
            message = "no run of multilevel splitting is done yet"
            raise ValueError(message)
        return _estimate(state, name=self.name)


def _restored(finished: FinishedStage) -> SplittingRun:
    """A run as an interrupted process left it."""
    return SplittingRun(
        log_probability=float(finished.kept["log_probability"]),
        simulated=int(finished.kept["simulated"]),
        levels=int(finished.kept["levels"]),
        scored=finished.scored,
    )


def split(problem: Problem, *, count: int, generator: np.random.Generator) -> SplittingRun:
    """One run of adaptive multilevel splitting with ``count`` particles."""
    particles = in_time(problem, lambda: draw_particles(problem, count=count, generator=generator))
    log_share, simulated, levels = 0.0, count, 0
    first_level = _level(particles)
    for _ in range(MOST_LEVELS):
        lowest, level = particles.lowest, _level(particles)
        problem.progress(_on_the_way(level, first_level, count=count), count)
        if level < VIOLATION_THRESHOLD:
            break
        killed = lowest >= level
        if killed.all():
            log_share = -math.inf
            break
        log_share += math.log1p(-float(killed.mean()))
        simulated += int(killed.sum())
        levels += 1
        particles = in_time(
            problem, partial(_replaced, problem, particles, killed, level, generator)
        )
    problem.progress(count, count)
    scored = score(problem, particles.rollouts)
    share = float(scored.violated.mean())
    log_probability = log_share + math.log(share) if share > 0.0 else -math.inf
    return SplittingRun(log_probability, simulated, levels, scored)


def _level(particles: Particles) -> float:
    return float(np.quantile(particles.lowest, 1.0 - KILLED_SHARE, method="higher"))


def _on_the_way(level: float, first_level: float, *, count: int) -> int:
    """``count`` times the share of the way from the first level down to a violation.

    How often particles are cut and continued is not known before: the level alone tells how
    far a run is. It falls with every cut.
    """
    way = first_level - VIOLATION_THRESHOLD
    if not (0.0 < way < math.inf):
        return 0
    return int(count * min(max((first_level - level) / way, 0.0), 1.0))


def _replaced(
    problem: Problem,
    particles: Particles,
    killed: BoolArray,
    level: float,
    generator: np.random.Generator,
) -> Particles:
    """Survivors, and continuations of survivors from where they first came below the level."""
    survivors = particles.take(~killed)
    parents = generator.integers(0, survivors.score.shape[0], size=int(killed.sum()))
    chosen = survivors.take(parents)
    cut = np.argmax(chosen.score < level, axis=1).astype(np.int64)
    continued = restarted(problem, chosen, cut=cut, generator=generator)
    return Particles.concatenate([survivors, continued])


def _estimate(state: SplittingState, *, name: str) -> Estimate:
    logs = np.array([run.log_probability for run in state.runs])
    failing = [row_sums(run.scored.rollouts.log_p[run.scored.violated]) for run in state.runs]
    log_p = np.concatenate(failing)
    nll_mean, nll_log_mean = negative_log_likelihood(log_p)
    died = int(np.isneginf(logs).sum())
    known = died < logs.size
    log_mean = log_sum(logs) - math.log(logs.size) if known else -math.inf
    relative = np.exp(logs - log_mean) if known else np.zeros(logs.size)
    error = float(np.std(relative, ddof=1)) / math.sqrt(logs.size) if logs.size > 1 else None
    interval = (
        log_normal_interval(log_mean, relative_error=error, degrees_of_freedom=logs.size - 1)
        if known and error is not None
        else (None, None)
    )
    return Estimate(
        method=name,
        probability=math.exp(log_mean),
        log10_probability=log_mean / math.log(10.0) if known else None,
        std_error=error * math.exp(log_mean) if known and error is not None else None,
        ci_low=interval[0],
        ci_high=interval[1],
        rollouts_simulated=sum(run.simulated for run in state.runs),
        rollouts_in_estimate=sum(run.scored.rollouts.count for run in state.runs),
        failures=int(log_p.size),
        nll_mean=nll_mean,
        nll_log_mean=nll_log_mean,
        ess=None,
        pareto_k=None,
        max_weight_share=None,
        unbiased_probability=math.exp(log_mean),
        unbiased_std_error=error * math.exp(log_mean) if known and error is not None else None,
        diagnostics=run_diagnostics(died=died, runs=logs.size),
    )
