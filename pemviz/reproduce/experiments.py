"""What is to be reproduced and with what effort; each experiment, a repetition at a time."""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.special import expit

from pemviz import stl
from pemviz.analysis.detection_curves import gap_grid, initial_states
from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ExperimentConfig, MetricName
from pemviz.config.toml_files import load_preset
from pemviz.proposals.fixed import ConstantProposal
from pemviz.runs.experiment import build_experiment
from pemviz.runs.specification import build_metric
from pemviz.sampling.problem import sample
from pemviz.sampling.seeds import stage_seeds
from pemviz.sampling.zero_variance.reference import Reference, reference
from pemviz.types import Estimate, Proposal, Simulator

Part = Literal["table1", "table2", "table3", "figures"]
PARTS: tuple[Part, ...] = get_args(Part)
METRICS: tuple[MetricName, ...] = get_args(MetricName)


_built = lru_cache(maxsize=8)(build_experiment)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How the paper is reproduced; the defaults are the paper's own budgets.

    Attributes:
        parts: Which tables and figures.
        repetitions: Of every experiment.
        seed: Root of all randomness.
        pem: Perception error model: a shipped name or a file.
        data: The paper's training set, for Table I.
        workers: Processes; the results do not depend on them.
        monte_carlo_rollouts: Of the two Monte Carlo rows.
        naive_rollouts: Of the two rows that detect with probability 0.5.
        least_safe_rollouts: Among which the least safe that holds is sought.
        figure_stage: Whose learned proposals are compared between metrics.
        reference_rollouts: Behind the exact reference.
        base: What all experiments share; the ``paper`` preset.
    """

    parts: tuple[Part, ...] = PARTS
    repetitions: int = 10
    seed: int = 0
    pem: str = "ml-nn"
    data: Path | None = None
    workers: int = 2
    monte_carlo_rollouts: tuple[int, int] = (100, 10_000)
    naive_rollouts: tuple[int, int] = (100, 1_000)
    least_safe_rollouts: int = 10_000
    figure_stage: int = 3
    reference_rollouts: int = 20_000
    base: ExperimentConfig = field(default_factory=lambda: load_preset("paper-algorithm"))

    @property
    def experiment(self) -> ExperimentConfig:
        """The paper's experiment with this model and seed, one repetition."""
        return replace(self.base, pem=self.pem, seed=self.seed, repetitions=1)

    def adaptive(self, metric: MetricName) -> ExperimentConfig:
        """The paper's algorithm under a metric."""
        return replace(self.experiment, method="adaptive", metric=metric)


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
    experiment = _built(config)
    method, problem = experiment.method, experiment.problem
    state = method.init(problem, repetition=repetition)
    curves: dict[int, FloatArray] = {}
    while not method.is_done(state):
        state, stage = method.step(problem, state)
        if stage.learned is not None:
            curves[stage.stage] = proposal_curve(problem.simulator, stage.learned)
    return RepetitionOutcome(estimate=method.estimate(state), curves=curves)


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
