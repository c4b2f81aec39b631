"""What the engine reports to observers: recorder, panel, progress bar, store, a program's own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from pemviz.arrays import AnyArray
from pemviz.config import ExperimentConfig
from pemviz.pem import Pem
from pemviz.runs.result import RunResult
from pemviz.sampling.method import Foreseen
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Estimate, Signal, Simulator, StageResult


@dataclass(frozen=True)
class RunStarted:
    """A run begins.

    Attributes:
        config: The configuration.
        signals: The scenario's signals.
        simulator: The scenario in its own steps.
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
    """A batch of a stage's rollouts is done.

    Splitting cuts and continues its particles as often as it takes: there ``done`` is the total
    times the share of the way from the first level to a violation.

    Attributes:
        repetition: Zero-based.
        stage: Zero-based; once rollouts are simulated again, how many stages there were.
        done: Rollouts.
        total: How many it will be.
        again: Some of all stages' rollouts are simulated a second time.
    """

    repetition: int
    stage: int
    done: int
    total: int
    again: bool = False


@dataclass(frozen=True)
class RolloutsSearched:
    """Rollouts are simulated that are no stage's: a search for failure modes, or for levels.

    Attributes:
        repetition: Zero-based.
        stage: Zero-based; beside, before or after whose own rollouts they come.
        count: How many, since this was last told.
    """

    repetition: int
    stage: int
    count: int


@dataclass(frozen=True)
class StageDone:
    """A stage is done.

    Attributes:
        stage: In the scenario's own steps; its arrays are read-only.
        result: The run's result so far.
        foreseen: What its repetition has still to sample; ``None`` where a method does not tell.
    """

    stage: StageResult
    result: RunResult
    foreseen: Foreseen | None = None


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
    """A run has come to its end, or was stopped: its result has status ``done`` or ``stopped``."""

    result: RunResult


@dataclass(frozen=True)
class RunFailed:
    """A run failed, by one line that a person can act on; the result has what was finished."""

    message: str
    result: RunResult


Event = (
    RunStarted | RolloutsDone | RolloutsSearched | StageDone | RepetitionDone | RunDone | RunFailed
)


class Observer(Protocol):
    """Something that listens to a run. It never changes what the run computes."""

    def notify(self, event: Event) -> None:
        """Take note of ``event``."""
        ...


def notify_all(observers: Sequence[Observer], event: Event) -> None:
    """Notify every observer, in order."""
    for observer in observers:
        observer.notify(event)
