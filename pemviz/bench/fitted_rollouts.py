"""Rollouts drawn from fitted proposals: the compiled loop against numpy."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

from pemviz.config import ExperimentConfig
from pemviz.pem.models.protocol import Pem
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.fitted.drawing import compiled_draw, simulated
from pemviz.sampling.rollouts.batches import BatchTask, by_numpy
from pemviz.types import RolloutBatch, Simulator

DRAWN = {
    "rollouts from a network of the gap": ExperimentConfig(method="adaptive"),
    "rollouts from pilots and fits": ExperimentConfig(method="mixture"),
    "rollouts from pilots and fits, with memory of misses": ExperimentConfig(
        method="mixture", memory_s=0.25
    ),
}
"""Whose final rollouts are drawn, by what the row is called."""


@dataclass
class LastBatch:
    """The last batch that a run's method asked for: of the proposals that it ends with.

    Attributes:
        simulator: The scenario, as the method has it.
        pem: The error model.
        task: The batch, marked as one of many.
    """

    simulator: Simulator | None = field(default=None, init=False)
    pem: Pem | None = field(default=None, init=False)
    task: BatchTask | None = field(default=None, init=False)

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks`` by numpy, in order."""
        for task in tasks:
            self.simulator, self.pem, self.task = simulator, pem, replace(task, many=True)
            yield by_numpy(simulator, pem, task)

    def by_numpy(self) -> RolloutBatch:
        """It, simulated by numpy."""
        return by_numpy(*self._given())

    def by_loop(self) -> RolloutBatch:
        """It, simulated by the compiled loop, where there is one."""
        return simulated(*self._given())

    def _given(self) -> tuple[Simulator, Pem, BatchTask]:
        assert self.simulator is not None and self.pem is not None and self.task is not None  # noqa: S101, PT018  drawn
        return self.simulator, self.pem, self.task


def has_loop() -> bool:
    """Whether there is a compiled loop."""
    return compiled_draw() is not None


def last_batch(config: ExperimentConfig, *, rollouts: int) -> LastBatch:
    """The last of a final batch of ``rollouts``."""
    last, experiment = LastBatch(), build_experiment(replace(config, final_rollouts=rollouts))
    problem, method = replace(experiment.problem, run_batches=last), experiment.method
    state = method.init(problem, repetition=0)
    while not method.is_done(state):
        state, _ = method.step(problem, state)
    return last
