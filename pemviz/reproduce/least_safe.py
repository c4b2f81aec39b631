"""The least safe of many random rollouts under each metric, among those that do not violate."""

from dataclasses import dataclass, replace

import numpy as np

from pemviz import stl
from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ExperimentConfig, MetricName
from pemviz.proposals.fixed import ConstantProposal
from pemviz.runs.experiment import build_experiment
from pemviz.runs.specification import build_metric
from pemviz.sampling.method import stage_seeds
from pemviz.sampling.problem import sample


@dataclass(frozen=True)
class LeastSafe:
    """One metric's least robust rollout.

    Attributes:
        metric: The metric.
        rollout: Its index among the random rollouts.
        robustness: Under the metric.
        gap_m: ``[T]``.
        detected: ``[T-1]``.
        margin_m: Classical robustness [m].
    """

    metric: MetricName
    rollout: int
    robustness: float
    gap_m: FloatArray
    detected: BoolArray
    margin_m: float


@dataclass(frozen=True)
class LeastSafeSearch:
    """What was found among ``rollouts`` random ones, ``violating`` of which violate."""

    rollouts: int
    violating: int
    dt_s: float
    found: tuple[LeastSafe, ...]


def find_least_safe(
    config: ExperimentConfig, metrics: tuple[MetricName, ...], rollouts: int
) -> LeastSafeSearch:
    """Sample with the naive method and rank what does not violate; empty if all violate."""
    experiment = build_experiment(config)
    problem = experiment.problem
    scored = sample(
        problem,
        proposal=ConstantProposal(config.naive_detection_probability),
        count=rollouts,
        seeds=stage_seeds(seed=config.seed, repetition=0, stage=0),
    )
    holding = np.flatnonzero(~scored.violated)
    held = scored.rollouts.take(holding)
    found: list[LeastSafe] = []
    for metric in metrics if holding.size else ():
        ranking = build_metric(replace(config, metric=metric), problem.simulator)
        robustness = stl.robustness(experiment.formula, held.signals, ranking)
        classical = stl.robustness(experiment.formula, held.signals, stl.Classical())
        place = int(np.argmin(robustness))
        found.append(
            LeastSafe(
                metric=metric,
                rollout=int(holding[place]),
                robustness=float(robustness[place]),
                gap_m=np.array(held.signals["gap"][place]),
                detected=np.array(held.detected[place]),
                margin_m=float(classical[place]),
            )
        )
    return LeastSafeSearch(
        rollouts=rollouts,
        violating=rollouts - int(holding.size),
        dt_s=problem.simulator.dt_s,
        found=tuple(found),
    )
