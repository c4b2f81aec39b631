from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.recording import Recorder
from pemviz.recording.plot import Frame
from pemviz.runs.engine import run
from pemviz.runs.events import StageDone
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.runs.result import RunResult
from pemviz.runs.store import RunStore
from pemviz.types import StageResult
from tests.recording import read_back
from tests.toy import constant_pem

LEARNING = ExperimentConfig(method="adaptive", stages=2, rollouts=40, final_rollouts=60, epochs=20)


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


def chunks(path: Path) -> list:
    return list(read_back.chunks(path))


def texts(path: Path) -> dict[str, str]:
    """The last text at each path."""
    found = {}
    for chunk in chunks(path):
        batch = chunk.to_record_batch()
        if "TextDocument:text" in batch.schema.names:
            found[chunk.entity_path] = batch["TextDocument:text"].to_pylist()[-1][0]
    return found


def strips(path: Path, entity: str) -> list[np.ndarray]:
    """The last line strips ``[N, 2]`` at a path."""
    name = "LineStrips2D:strips"
    batches = [c.to_record_batch() for c in chunks(path) if c.entity_path == entity]
    found = [b[name].to_pylist()[-1] for b in batches if name in b.schema.names]
    assert found, f"no lines at {entity}"
    return [np.array(strip, dtype=np.float64) for strip in found[-1]]


def dots(path: Path, entity: str) -> np.ndarray:
    """The last points ``[N, 2]`` at a path."""
    name = "Points2D:positions"
    batches = [c.to_record_batch() for c in chunks(path) if c.entity_path == entity]
    found = [b[name].to_pylist()[-1] for b in batches if name in b.schema.names]
    assert found, f"no points at {entity}"
    return np.array(found[-1], dtype=np.float64)


def words(path: Path) -> dict[str, list[str]]:
    """The last labels at each path."""
    found = {}
    for chunk in chunks(path):
        batch = chunk.to_record_batch()
        for name in ("Points2D:labels", "Points3D:labels"):
            if name in batch.schema.names:
                found[chunk.entity_path] = batch[name].to_pylist()[-1]
    return found


def values_at(frame: Frame, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What was drawn at places ``[N, 2]``."""
    across, up = places[:, 0] / frame.shape.width, 1.0 - places[:, 1]
    return (
        frame.x.low + across * (frame.x.high - frame.x.low),
        frame.y.low + up * (frame.y.high - frame.y.low),
    )


def scalars(path: Path, entity: str, timeline: str) -> dict[int, list[float]]:
    """Rows of scalars by time."""
    rows = {}
    for chunk in chunks(path):
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            rows.update(
                zip(batch[timeline].to_pylist(), batch["Scalars:scalars"].to_pylist(), strict=True)
            )
    return rows
