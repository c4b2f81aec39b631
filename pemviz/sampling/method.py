"""The shape that all methods share: immutable state, advanced one stage at a time."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config.ranges import AtLeastZero, Count
from pemviz.sampling.estimates.importance_weights import log_mean_failing_weight
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.seeds import stage_seeds
from pemviz.types import Estimate, Proposal, SampledRollouts, ScoredRollouts, StageResult

State = TypeVar("State")
State_contra = TypeVar("State_contra", contravariant=True)


@dataclass(frozen=True)
class SurrogateLearning:
    """What a surrogate was simulated for, before the simulator itself was."""

    name: str
    """The surrogate's."""
    rollouts: Count
    """Of the surrogate, in all repetitions."""
    probability: AtLeastZero
    """That it violates, by these; 0: nothing did, and it taught nothing."""


class Method(Protocol[State]):
    """A way to estimate a failure probability.

    ``init`` and ``step`` are pure; a repetition is ``init`` and then ``step`` until
    ``is_done``. Randomness comes from the seeds alone.
    """

    @property
    def name(self) -> str:
        """As chosen with ``--method``."""
        ...

    @property
    def stages(self) -> int:
        """How many times ``step`` is called, for progress displays."""
        ...

    def init(self, problem: Problem, *, repetition: int) -> State:
        """The state before the first stage of a repetition."""
        ...

    def step(self, problem: Problem, state: State) -> tuple[State, StageResult]:
        """Carry out the next stage."""
        ...

    def is_done(self, state: State) -> bool:
        """Whether no stage is left."""
        ...

    def estimate(self, state: State) -> Estimate:
        """The repetition's estimate, once it is done."""
        ...


@dataclass(frozen=True)
class Foreseen:
    """What a repetition has still to sample, by what was decided after the stage before.

    Attributes:
        rollouts: In stages.
        learning_stages: Stages that are learned from.
        searches: Rollouts beside the stages', in which failure modes may be searched for.
        may_grow: Whether what is learned may ask for more.
    """

    rollouts: int
    learning_stages: int = 0
    searches: int = 0
    may_grow: bool = False


@runtime_checkable
class ForeseesRollouts(Protocol[State_contra]):
    """A method that tells how far it is."""

    def foreseen(self, state: State_contra) -> Foreseen | None:
        """What is left of a repetition; ``None`` while that cannot be told."""
        ...


@runtime_checkable
class PoolsStages(Protocol[State_contra]):
    """A method whose estimate averages the rollouts of all stages, weighted together."""

    def pooled_log_weight(self, state: State_contra) -> FloatArray:
        """Log weights ``[N]`` of all rollouts of a repetition that is done, in order.

        NaN where a rollout does not violate and its weight is not known.
        """
        ...


@runtime_checkable
class LearnsOnSurrogate(Protocol[State_contra]):
    """A method that may learn on a surrogate before it simulates."""

    def surrogate_learning(self, state: State_contra) -> SurrogateLearning | None:
        """What a repetition has; ``None`` if nothing."""
        ...


@runtime_checkable
class AnswersRules(Protocol[State]):
    """A method that also answers each of several rules from what it has sampled."""

    def under_rule(self, state: State, rule: str) -> State:
        """The state as it would be had the verdicts been those of one rule."""
        ...


def sample_stage(
    problem: Problem,
    *,
    proposal: Proposal,
    count: int,
    seed: int,
    repetition: int,
    stage: int,
) -> ScoredRollouts:
    """A stage's rollouts: those that an interrupted run left, or else sampled and scored.

    Raises:
        SimulationError: A batch has something that is no finite number, or takes too long.
    """
    return finished_or(
        problem,
        lambda: sample(
            problem,
            proposal=proposal,
            count=count,
            seeds=stage_seeds(seed=seed, repetition=repetition, stage=stage),
        ),
        repetition=repetition,
        stage=stage,
    )


def finished_or(
    problem: Problem, draw: Callable[[], ScoredRollouts], *, repetition: int, stage: int
) -> ScoredRollouts:
    """A stage's rollouts as an interrupted run left them, or else what ``draw`` returns."""
    finished = problem.finished(repetition, stage)
    if finished is None:
        return draw()
    count = finished.scored.rollouts.count
    problem.progress(count, count)
    return finished.scored


def final_stage(
    *,
    repetition: int,
    stage: int,
    scored: ScoredRollouts,
    sampled_from: Proposal,
    sampled: SampledRollouts | None = None,
) -> StageResult:
    """The record of a stage from which nothing is learned.

    ``sampled`` are all of its rollouts, where ``scored`` holds some alone.
    """
    violated = scored.violated if sampled is None else sampled.violated
    failures, probability, log10_probability, ess = int(violated.sum()), 0.0, None, None
    if failures:
        log_weight = scored.rollouts.log_weight if sampled is None else sampled.log_weight
        log_probability = log_mean_failing_weight(log_weight, violated)
        probability = float(np.exp(log_probability))
        log10_probability = log_probability / float(np.log(10.0))
        ess = effective_sample_size(log_weight[violated])
    return StageResult(
        repetition=repetition,
        stage=stage,
        kind="final",
        scored=scored,
        sampled_from=sampled_from,
        learned=None,
        threshold=None,
        elites=0,
        failures=failures,
        probability=probability,
        log10_probability=log10_probability,
        ess=ess,
        loss=None,
        timings_s=scored.timings_s,
        sampled=sampled,
    )


VIOLATION_THRESHOLD = 0.0


def elite_threshold(robustness: FloatArray, *, sigma: float) -> float:
    """The stage's level: element floor(sigma N) of robustness ``[N]`` sorted descending.

    Never below 0, the threshold of violation (the paper's Algorithm 1, lines 6 and 7).
    """
    descending = np.sort(robustness)[::-1]
    # a product such as 0.95 * 100 must not round below the whole number it stands for
    index = min(math.floor(sigma * robustness.size + 1e-9), robustness.size - 1)
    return max(float(descending[index]), VIOLATION_THRESHOLD)


def elites(robustness: FloatArray, *, threshold: float) -> BoolArray:
    """Which of ``[N]`` rollouts lie at or below the level, ties included."""
    return robustness <= threshold
