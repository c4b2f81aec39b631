"""What the engine tells its observers; recorder, panel, progress bar and store listen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from pemviz.arrays import AnyArray
from pemviz.config import ExperimentConfig
from pemviz.pem import Pem
from pemviz.runs.result import RunResult
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Estimate, Signal, Simulator, StageResult


@dataclass(frozen=True)
class RunStarted:
    """A run begins.

    Attributes:
        config: What was asked.
        signals: The scenario's signals.
        simulator: The back end, for views that need its time step or salient variables.
        pem: The perception error model.
        stages: How many stages a repetition has.
        planned_rollouts: How many rollouts the run will simulate; with splitting, how many
            particles, each of which is cut and continued as often as it takes.
        result: The result so far: provenance, and nothing estimated yet.
    """

    config: ExperimentConfig
    signals: tuple[Signal, ...]
    simulator: Simulator | SlotSimulator
    pem: Pem
    stages: int
    planned_rollouts: int
    result: RunResult


@dataclass(frozen=True)
class RolloutsDone:
    """A batch of rollouts is done.

    Attributes:
        repetition: Zero-based.
        stage: The stage they belong to.
        done: Rollouts of the stage that are done. Splitting cuts and continues its particles as
            often as it takes: there it is the total times the share of the way from the first
            level to a violation.
        total: Rollouts of the stage.
    """

    repetition: int
    stage: int
    done: int
    total: int


@dataclass(frozen=True)
class StageDone:
    """A stage is done; its arrays are read-only.

    Attributes:
        stage: The stage with its rollouts, in the scenario's own steps.
        result: The run's result so far.
    """

    stage: StageResult
    result: RunResult


@dataclass(frozen=True)
class RepetitionDone:
    """A repetition is done.

    Attributes:
        repetition: Zero-based.
        estimate: Its estimate.
        result: The run's result so far.
        columns: What the estimate needs of each of the repetition's rollouts beside what every run
            folder keeps, ``[N]`` by name (:class:`pemviz.sampling.kept.KeepsColumns`).
    """

    repetition: int
    estimate: Estimate
    result: RunResult
    columns: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])


@dataclass(frozen=True)
class RunDone:
    """A run has come to its end, or was stopped.

    Attributes:
        result: Complete, with status ``done`` or ``stopped``.
    """

    result: RunResult


@dataclass(frozen=True)
class RunFailed:
    """A run failed; what was finished before is in the result.

    Attributes:
        message: One line that a person can act on.
        result: With status ``failed``.
    """

    message: str
    result: RunResult


Event = RunStarted | RolloutsDone | StageDone | RepetitionDone | RunDone | RunFailed


class Observer(Protocol):
    """Something that listens to a run. It never changes what the run computes."""

    def notify(self, event: Event) -> None:
        """Take note of ``event``."""
        ...


def notify_all(observers: Sequence[Observer], event: Event) -> None:
    """Tell every observer, in order."""
    for observer in observers:
        observer.notify(event)
