from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from pemviz.config import ExperimentConfig
from pemviz.recording import Recorder
from pemviz.runs.engine import run
from pemviz.runs.events import StageDone
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.runs.result import RunResult
from pemviz.runs.run_folder import RunStore
from pemviz.types import StageResult
from tests.toy import constant_pem

LEARNING = ExperimentConfig(
    method="adaptive",
    stages=2,
    rollouts=40,
    final_rollouts=60,
    epochs=20,
    measured_memory=False,
)


class Listener:
    """Keeps the stages and events it hears."""

    def __init__(self):
        self.events = []

    def notify(self, event):
        self.events.append(event)

    @property
    def stages(self) -> list[StageResult]:
        return [event.stage for event in self.events if isinstance(event, StageDone)]


@dataclass(frozen=True)
class Recorded:
    """A run and what it left."""

    folder: Path
    result: RunResult
    events: list
    stages: list[StageResult]

    @property
    def path(self) -> Path:
        return self.folder / "run.rrd"


def with_blind_pem(config: ExperimentConfig) -> Experiment:
    """The experiment with an error model that misses half of the time: violations are common."""
    experiment = build_experiment(config)
    pem = constant_pem(detection_probability=0.5)
    return replace(experiment, problem=replace(experiment.problem, pem=pem))


def record(experiment: Experiment, folder: Path, observers=(), **options) -> Recorded:
    listener = Listener()
    recorder = Recorder(folder / "run.rrd", **options)
    result = run(
        experiment, run_id="a-run", observers=[RunStore(folder), listener, recorder, *observers]
    )
    return Recorded(folder, result, listener.events, listener.stages)


@pytest.fixture(scope="session")
def learned(tmp_path_factory) -> Recorded:
    """An adaptive run with violations in every stage."""
    return record(with_blind_pem(LEARNING), tmp_path_factory.mktemp("learned"))
