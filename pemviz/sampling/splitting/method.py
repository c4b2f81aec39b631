"""Multilevel splitting: rollouts that come close are cut and continued, level by level.

Norden, O'Kelly, Sinha 2019 use it for black-box assessment of driving; the estimator is the
adaptive multilevel splitting of Brehier, Gazeau, Goudenege, Lelievre, Rousset 2016, which is
unbiased with ties. It needs no likelihood ratios: an independent check of the other methods.

N particles follow the error model. Level l is their median; the K_l of them that never came below
it are replaced by continuations of others, each from where it first came below. Levels fall until
the median violates, or none came below (then mu_r = 0). F of them violate in the end. What is
compared with levels is the importance function of :mod:`pemviz.sampling.splitting.importance`::

    run       mu_r = (F / N) prod_l (1 - K_l / N)
    estimate  mu   = 1 / R sum_r mu_r, standard error: deviation of mu_1 .. mu_R over sqrt(R)
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.method import final_stage
from pemviz.sampling.problem import FinishedStage, Problem
from pemviz.sampling.rollouts.large_stages import log_p_of
from pemviz.sampling.seeds import stage_seeds
from pemviz.sampling.splitting.estimate import SHARED, columns_of, estimate_of_runs
from pemviz.sampling.splitting.run import SplittingRun, split
from pemviz.types import Estimate, StageResult

RULE = "common_ancestry."


@dataclass(frozen=True)
class SplittingState:
    """The repetition, its runs so far, and those that were carried out with the last of them."""

    repetition: int
    runs: tuple[SplittingRun, ...] = ()
    ahead: tuple[SplittingRun, ...] = ()


@dataclass(frozen=True, kw_only=True)
class SplittingSampling:
    """Independent runs of adaptive multilevel splitting, averaged.

    Attributes:
        stages: How many runs; at least five, for a standard error and an interval.
        rollouts: Particles in each.
        seed: Root of all randomness.
    """

    stages: int
    rollouts: int
    seed: int
    name: str = "splitting"

    def init(self, problem: Problem, *, repetition: int) -> SplittingState:  # noqa: ARG002
        """Nothing is sampled yet."""
        return SplittingState(repetition=repetition)

    def step(self, problem: Problem, state: SplittingState) -> tuple[SplittingState, StageResult]:
        """Carry out one run, and with it as many as make up a batch of rollouts."""
        stage = len(state.runs)
        finished = problem.finished(state.repetition, stage)
        if finished is None:
            run, *ahead = state.ahead or self._next_runs(problem, state)
        else:
            run, ahead = _restored(finished), []
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

    def _next_runs(self, problem: Problem, state: SplittingState) -> Sequence[SplittingRun]:
        first = len(state.runs)
        together = max(problem.batch_rollouts // self.rollouts, 1)
        seeds = [
            stage_seeds(seed=self.seed, repetition=state.repetition, stage=stage)
            for stage in range(first, min(first + together, self.stages))
        ]
        generators = [np.random.default_rng(one) for one in seeds]
        return split(problem, count=self.rollouts, generators=generators)

    def under_rule(self, state: SplittingState, rule: str) -> SplittingState:
        """The same particles with the verdict of one rule."""
        return replace(state, runs=tuple(run.under_rule(rule) for run in state.runs))

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
        return estimate_of_runs(state.runs, method=self.name)

    def kept_columns(self, state: SplittingState) -> Mapping[str, AnyArray]:
        """What each run's particles share."""
        return columns_of(state.runs)


def _restored(finished: FinishedStage) -> SplittingRun:
    """A run as an interrupted process left it."""
    scored, kept = finished.scored, finished.kept
    return SplittingRun(
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
