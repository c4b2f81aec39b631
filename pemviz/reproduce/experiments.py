"""The experiments behind the tables and figures, each repetition on its own."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.special import expit

from pemviz.analysis.detection_curves import gap_grid, initial_states
from pemviz.arrays import FloatArray
from pemviz.config import ExperimentConfig
from pemviz.reproduce.settings import METRICS, Settings
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.sampling.zero_variance.reference import Reference, reference
from pemviz.types import Estimate, Proposal, Simulator


@dataclass(frozen=True)
class RepetitionOutcome:
    """One repetition of an experiment, small enough to travel between processes.

    Attributes:
        estimate: Its estimate.
        curves: P(detected) of what each stage learned, ``[G]`` by stage, on the scenario's
            grid of gaps.
    """

    estimate: Estimate
    curves: dict[int, FloatArray]


def table_2_experiments(settings: Settings) -> dict[str, ExperimentConfig]:
    """Configurations by the row's name."""
    base = settings.experiment
    return {
        **{
            f"mc_{count}": replace(base, method="monte-carlo", final_rollouts=count)
            for count in settings.monte_carlo_rollouts
        },
        **{
            f"naive_{count}": replace(base, method="naive", final_rollouts=count)
            for count in settings.naive_rollouts
        },
        f"adaptive_{base.final_rollouts}": settings.adaptive("classical"),
    }


def metric_experiments(settings: Settings) -> dict[str, ExperimentConfig]:
    """The paper's algorithm by metric, for Table III and the figures."""
    return {metric: settings.adaptive(metric) for metric in METRICS}


def run_repetition(config: ExperimentConfig, repetition: int) -> RepetitionOutcome:
    """Carry out one repetition; to the last bit what a run of several makes of it."""
    experiment = _experiment(config)
    method, problem = experiment.method, experiment.problem
    state = method.init(problem, repetition=repetition)
    curves: dict[int, FloatArray] = {}
    while not method.is_done(state):
        state, stage = method.step(problem, state)
        if stage.learned is not None:
            curves[stage.stage] = proposal_curve(problem.simulator, stage.learned)
    return RepetitionOutcome(estimate=method.estimate(state), curves=curves)


@lru_cache(maxsize=8)
def _experiment(config: ExperimentConfig) -> Experiment:
    return build_experiment(config)


def proposal_curve(simulator: Simulator, proposal: Proposal) -> FloatArray:
    """P(detected) ``[G]`` of a proposal that depends on the gap alone."""
    gap_m = gap_grid(simulator)
    logit = proposal.logit(initial_states(simulator, gap_m=gap_m), np.zeros(gap_m.size))
    return np.asarray(expit(logit), dtype=np.float64)


def exact_reference(config: ExperimentConfig, rollouts: int) -> Reference:
    """The exact probability of ``config``'s experiment, to a fraction of a per cent.

    Raises:
        InputError: Single states do not decide the specification, or the simulator has no twin.
    """
    experiment = build_experiment(replace(config, reference=True))
    assert experiment.twin is not None  # noqa: S101  else no reference could be asked for
    return reference(experiment.problem, twin=experiment.twin, rollouts=rollouts)
