"""What is to be reproduced, and with what effort."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

from pemviz.config import ExperimentConfig, MetricName
from pemviz.config.toml_files import load_preset

Part = Literal["table1", "table2", "table3", "figures"]
PARTS: tuple[Part, ...] = get_args(Part)
METRICS: tuple[MetricName, ...] = get_args(MetricName)


def _paper() -> ExperimentConfig:
    return load_preset("paper-algorithm")


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
    base: ExperimentConfig = field(default_factory=_paper)

    @property
    def experiment(self) -> ExperimentConfig:
        """The paper's experiment with this model and seed, one repetition."""
        return replace(self.base, pem=self.pem, seed=self.seed, repetitions=1)

    def adaptive(self, metric: MetricName) -> ExperimentConfig:
        """The paper's algorithm under a metric."""
        return replace(self.experiment, method="adaptive", metric=metric)
