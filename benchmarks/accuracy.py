"""How wrong each method is: many seeds on scenarios whose failure probability is known."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from pemviz.config import ExperimentConfig
from pemviz.processes import map_in_processes
from pemviz.runs.experiment import build_experiment, build_method
from pemviz.sampling.estimates.diagnostics import reference_disagreement
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sampling.method import Method
from pemviz.sampling.problem import Problem
from pemviz.sampling.registry import by_name
from pemviz.sampling.zero_variance.reference import (
    Reference,
    exact_log_probability,
    reference,
)
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import Diagnostic, Estimate

SEEDS_PER_JOB = 10
CONFIDENCE = 0.95
FAR = 2.0
"""An estimate that is off by more than this factor misleads, unless it warns."""
CLOSE = 0.1
"""An estimate that is off by no larger share of the truth than this warns in vain, if it does."""


@dataclass(frozen=True)
class Case:
    """One method at one budget on one scenario.

    Attributes:
        scenario: Its name in tables.
        config: What is run; only the seed varies.
        truth: The failure probability.
    """

    scenario: str
    config: ExperimentConfig
    truth: float


@dataclass(frozen=True)
class Outcome:
    """One run of a case.

    Attributes:
        ratio: Estimate over truth.
        covers: Whether the 95 % interval contains the truth.
        rollouts: Simulated in all stages.
        wall_s: Wall time, without what runs share [s].
        warned: Whether the diagnostics call the estimate unreliable.
        diagnostics: Kinds of all its diagnostics, those that leave it reliable as well.
        interval: Both ends over truth; ``None`` where no interval is given.
    """

    ratio: float
    covers: bool
    rollouts: int
    wall_s: float
    warned: bool = False
    diagnostics: Sequence[str] = ()
    interval: Sequence[float] | None = None

    @property
    def width_needed(self) -> float | None:
        """Distance of truth and estimate over that of the interval's end on that side, in logs.

        An interval so many times as wide would just contain the truth. ``None`` without an
        interval whose ends are above 0 and apart from the estimate.
        """
        if self.interval is None or min(*self.interval, self.ratio) <= 0.0:
            return None
        end = self.interval[0 if self.ratio > 1.0 else 1]
        width = abs(math.log(end / self.ratio))
        return abs(math.log(self.ratio)) / width if width > 0.0 else None

    @property
    def misleads(self) -> bool:
        """Whether it is off by more than a factor of 2 and nothing warns."""
        return not self.warned and not 1.0 / FAR <= self.ratio <= FAR

    @property
    def is_close(self) -> bool:
        """Whether it is within 10 % of the truth."""
        return abs(self.ratio - 1.0) <= CLOSE


@dataclass(frozen=True)
class Accuracy:
    """What the runs of one case, or of several pooled, show.

    Attributes:
        scenario: The scenario, or ``all``.
        method: The method.
        rollouts: Of one run, all stages.
        runs: How many.
        truth: The failure probability; ``None`` for pooled scenarios.
        relative_rmse: Root mean square of estimate / truth - 1.
        median_ratio: Median of estimate / truth.
        coverage: Share of intervals that contain the truth.
        coverage_low: Exact binomial interval of that share at 95 %, lower end.
        coverage_high: Upper end.
        warned: Share of runs whose diagnostics call the estimate unreliable.
        close_warned: Likewise of the runs within 10 % of the truth; ``None`` without any.
        unwarned_coverage: Share of the other runs' intervals that contain the truth; ``None``
            without any.
        unwarned_coverage_low: Exact binomial interval of that share at 95 %, lower end.
        unwarned_coverage_high: Upper end.
        unwarned_width: Intervals of unwarned runs so many times as wide, in logs, would contain
            the truth in 95 %; ``None`` without any.
        misleading: Share of all runs that are off by more than a factor of 2 unwarned.
        median_wall_s: Median wall time of a run [s].
    """

    scenario: str
    method: str
    rollouts: int
    runs: int
    truth: float | None
    relative_rmse: float
    median_ratio: float
    coverage: float
    coverage_low: float
    coverage_high: float
    warned: float
    close_warned: float | None
    unwarned_coverage: float | None
    unwarned_coverage_low: float | None
    unwarned_coverage_high: float | None
    unwarned_width: float | None
    misleading: float
    median_wall_s: float


def with_budget(config: ExperimentConfig, *, method: str, rollouts: int) -> ExperimentConfig:
    """``config`` with a method that simulates ``rollouts`` in all, stages included.

    Splitting is given so many particles: how often they are cut and continued is not known
    before, and comes on top.

    Raises:
        InputError: Too few rollouts for the method.
    """
    return by_name(method).with_budget(replace(config, method=method), rollouts)


def known_probability(config: ExperimentConfig, *, rollouts: int = 200_000) -> float:
    """The failure probability: by recursion where it is exact, else by the reference.

    Raises:
        InputError: The specification is out of the reference's reach.
    """
    problem = build_experiment(replace(config, method="zero-variance")).problem
    twin = VectorizedSimulator(config.scenario)
    exact = exact_log_probability(problem, twin=twin)
    return math.exp(exact) if exact is not None else known_by_sampling(config, rollouts=rollouts)


def known_by_sampling(config: ExperimentConfig, *, rollouts: int) -> float:
    """The failure probability by importance sampling with the twin's value function."""
    problem = build_experiment(replace(config, method="zero-variance")).problem
    twin = VectorizedSimulator(config.scenario)
    return reference(problem, twin=twin, rollouts=rollouts).probability


def measure(
    cases: Sequence[Case], *, seeds: int, workers: int, first_seed: int = 0
) -> Mapping[Case, Sequence[Outcome]]:
    """Run every case with ``seeds`` seeds, in ``workers`` processes.

    The outcomes do not depend on the number of workers.

    Raises:
        RunError: A process died.
    """
    jobs = [
        (case, tuple(range(start, min(start + SEEDS_PER_JOB, first_seed + seeds))))
        for case in cases
        for start in range(first_seed, first_seed + seeds, SEEDS_PER_JOB)
    ]
    parts = map_in_processes(_run_job, jobs, workers=workers)
    outcomes: dict[Case, list[Outcome]] = {case: [] for case in cases}
    for (case, _), part in zip(jobs, parts, strict=True):
        outcomes[case].extend(part)
    return outcomes


def summarise(
    outcomes: Sequence[Outcome], *, scenario: str, method: str, truth: float | None
) -> Accuracy:
    """The figures of at least one outcome."""
    ratio = np.array([outcome.ratio for outcome in outcomes])
    coverage, low, high = _coverage(outcomes)
    unwarned = [outcome for outcome in outcomes if not outcome.warned]
    close = [outcome.warned for outcome in outcomes if outcome.is_close]
    of_unwarned = _coverage(unwarned) if unwarned else (None, None, None)
    return Accuracy(
        scenario=scenario,
        method=method,
        rollouts=max(outcome.rollouts for outcome in outcomes),
        runs=len(outcomes),
        truth=truth,
        relative_rmse=float(np.sqrt(np.mean((ratio - 1.0) ** 2))),
        median_ratio=float(np.median(ratio)),
        coverage=coverage,
        coverage_low=low,
        coverage_high=high,
        warned=1.0 - len(unwarned) / len(outcomes),
        close_warned=sum(close) / len(close) if close else None,
        unwarned_coverage=of_unwarned[0],
        unwarned_coverage_low=of_unwarned[1],
        unwarned_coverage_high=of_unwarned[2],
        unwarned_width=_width_needed(unwarned),
        misleading=sum(outcome.misleads for outcome in outcomes) / len(outcomes),
        median_wall_s=float(np.median([outcome.wall_s for outcome in outcomes])),
    )


def _width_needed(outcomes: Sequence[Outcome]) -> float | None:
    needed = [outcome.width_needed for outcome in outcomes]
    found = [one for one in needed if one is not None]
    return float(np.quantile(found, CONFIDENCE)) if found else None


def _coverage(outcomes: Sequence[Outcome]) -> tuple[float, float, float]:
    """Share of intervals that contain the truth, with its exact binomial interval."""
    covering = sum(outcome.covers for outcome in outcomes)
    interval = stats.binomtest(covering, len(outcomes)).proportion_ci(CONFIDENCE, method="exact")
    return covering / len(outcomes), float(interval.low), float(interval.high)


def accuracy_table(outcomes: Mapping[Case, Sequence[Outcome]]) -> Sequence[Accuracy]:
    """A row for each case, and for each method and budget one over all scenarios."""
    rows = [
        summarise(found, scenario=case.scenario, method=case.config.method, truth=case.truth)
        for case, found in outcomes.items()
    ]
    pooled: dict[tuple[str, int], list[Outcome]] = {}
    for case, found in outcomes.items():
        key = (case.config.method, by_name(case.config.method).budget(case.config).rollouts)
        pooled.setdefault(key, []).extend(found)
    if len({case.scenario for case in outcomes}) > 1:
        rows += [
            summarise(found, scenario="all", method=method, truth=None)
            for (method, _), found in pooled.items()
        ]
    return rows


def _run_job(job: tuple[Case, tuple[int, ...]]) -> list[Outcome]:
    """The outcomes of one case for several seeds; what the runs share is built once."""
    case, seeds = job
    problem = build_experiment(case.config).problem
    methods = [build_method(replace(case.config, seed=seed)) for seed in seeds]
    methods[0].init(problem, repetition=0)
    return [run_once(method, problem, case.truth) for method in methods]


def run_once(
    method: Method[Any], problem: Problem, truth: float, *, beside: Reference | None = None
) -> Outcome:
    """One estimate beside the truth; its time is without what ``method`` builds first.

    Args:
        method: What estimates.
        problem: What is estimated.
        truth: The failure probability.
        beside: A reference that a run of this problem is compared with.
    """
    state = method.init(problem, repetition=0)
    began = time.perf_counter()
    while not method.is_done(state):
        state, _ = method.step(problem, state)
    estimate = method.estimate(state)
    low, high = estimate.ci_low, estimate.ci_high
    diagnostics = (*estimate.diagnostics, *_disagreement(estimate, beside))
    return Outcome(
        ratio=estimate.probability / truth,
        covers=low is not None and high is not None and low <= truth <= high,
        rollouts=estimate.rollouts_simulated,
        wall_s=time.perf_counter() - began,
        warned=bool(interval_caveats(estimate, diagnostics)),
        diagnostics=[diagnostic.kind for diagnostic in diagnostics],
        interval=None if low is None or high is None else [low / truth, high / truth],
    )


def _disagreement(estimate: Estimate, beside: Reference | None) -> Sequence[Diagnostic]:
    if beside is None:
        return ()
    return reference_disagreement(
        estimate, probability=beside.probability, std_error=beside.std_error
    )
