"""How large the recording of one repetition of the paper's experiment is, and what it costs."""

import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.figures import Figure
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import load_preset
from pemviz.recording import Recorder
from pemviz.runs.engine import run
from pemviz.runs.events import Observer
from pemviz.runs.experiment import Experiment, build_experiment

BYTES_A_MB = 1e6


def recording_figures(
    *, config: ExperimentConfig | None = None, repeats: int = 3
) -> Sequence[Figure]:
    """Run a ``paper`` repetition with and without a recorder, by turns.

    highway-env's pictures of the least robust rollout are left out: they are optional, and take
    as long however short the run is.

    Args:
        config: What to run; the preset ``paper-algorithm`` by default.
        repeats: Pairs of runs, after one that is not counted; the medians are compared.
    """
    experiment = build_experiment(load_preset("paper-algorithm") if config is None else config)
    alone_s: list[float] = []
    recorded_s: list[float] = []
    with tempfile.TemporaryDirectory(prefix="pemviz-bench-") as folder:
        path = Path(folder) / "run.rrd"
        _time_s(experiment, [Recorder(path)])
        for _ in range(repeats):
            alone_s.append(_time_s(experiment, []))
            recorded_s.append(_time_s(experiment, [Recorder(path)]))
        size_mb = path.stat().st_size / BYTES_A_MB
    ratio = statistics.median(recorded_s) / statistics.median(alone_s)
    return (
        Figure("paper repetition, recording", size_mb, "MB", "at most 8"),
        Figure("paper repetition, wall with recorder over without", ratio, "", "at most 1.25"),
    )


def _time_s(experiment: Experiment, observers: Sequence[Observer]) -> float:
    began = time.perf_counter()
    run(experiment, observers=observers)
    return time.perf_counter() - began
