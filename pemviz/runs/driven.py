"""How far the ego drives in a rollout of free traffic, for rates a kilometre."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np

from pemviz.proposals.fixed import PemProposal
from pemviz.runs.experiment import Experiment
from pemviz.runs.result import DrivenDistance, RunResult
from pemviz.sampling.problem import sample
from pemviz.simulators.latents import within

ROLLOUTS = 200
LEAST_KM = 1e-6
SPAWN_KEY = 2**32 - 2
"""Of the child of the run's seed that these rollouts are drawn by."""


@runtime_checkable
class DrivesFreely(Protocol):
    """A scenario whose rollouts are stretches of driving, not encounters."""

    @property
    def distance_signal(self) -> str:
        """Name of the signal that tells how far the ego has driven in the rollout [m]."""
        ...


def with_distance(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A result with the distance that a rollout is, where the scenario tells it.

    Args:
        result: With the estimate of all repetitions.
        experiment: What was run; its problem's ``pause`` may raise to stop.
    """
    scenario = within(experiment.problem.simulator, DrivesFreely)
    if scenario is None:
        return result
    scored = sample(
        experiment.problem.without_rules(),
        proposal=PemProposal(),
        count=ROLLOUTS,
        seeds=np.random.SeedSequence(experiment.config.seed, spawn_key=(SPAWN_KEY,)),
    )
    driven_km = scored.rollouts.signals[scenario.distance_signal][:, -1] / 1000.0
    mean_km = float(np.mean(driven_km))
    if mean_km < LEAST_KM:  # the ego stands: no distance to divide by
        return result
    driven = DrivenDistance(
        mean_km=mean_km,
        std_error_km=float(np.std(driven_km, ddof=1) / np.sqrt(ROLLOUTS)),
        rollouts=ROLLOUTS,
    )
    return replace(result, driven=driven)
