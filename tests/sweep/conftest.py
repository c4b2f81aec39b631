import os
from pathlib import Path

import pytest

from pemviz.cli.main import main
from pemviz.sweep.run_task import carry_out
from tests.comparable_results import comparable_result

ROOT = Path(__file__).resolve().parents[2]
TINY = """
method = "adaptive"
stages = 2
rollouts = 20
final_rollouts = 20
measured_memory = false
plan = false
epochs = 20
seed = 3
"""
VARIED = ["--vary", "alpha=0.1,0.5", "--vary", "metric=agm", "--seeds", "2"]


class InThisProcess:
    """Workers that carry a run out when its outcome is wanted; no process has to be started."""

    def __init__(self, count):
        self.capacity = count
        self._waiting = []

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def submit(self, task):
        self._waiting.append(task)

    def finished(self, *, timeout_s):
        return [carry_out(self._waiting.pop(0))]


@pytest.fixture
def in_this_process(monkeypatch):
    """What is not about processes is tried without."""
    monkeypatch.setattr("pemviz.cli.sweep.LocalWorkers", InThisProcess)


@pytest.fixture
def tiny(tmp_path) -> Path:
    """A configuration that runs in a fraction of a second."""
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


@pytest.fixture(scope="session")
def serial(tmp_path_factory) -> Path:
    """The folder of a sweep of four runs, one after the other in this process."""
    folder = tmp_path_factory.mktemp("serial")
    config = folder / "tiny.toml"
    config.write_text(TINY)
    words = [str(config), *VARIED, "--workers", "1", "--out", str(folder / "out")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pemviz.cli.sweep.LocalWorkers", InThisProcess)
        assert main(["sweep", *words]) == 0
    return folder / "out"


def contents(out: Path) -> dict[str, object]:
    """All that a sweep's results consist of: tables as bytes, results without timings."""
    found: dict[str, object] = {
        name: (out / name).read_bytes() for name in ("sweep.csv", "sweep.parquet", "summary.md")
    }
    for folder in sorted((out / "runs").iterdir()):
        found[folder.name] = (comparable_result(folder), (folder / "config.toml").read_bytes())
    return found


@pytest.fixture(scope="session", autouse=True)
def _workers_find_this_checkout():
    """Processes that tests start import pemviz as this one does."""
    with pytest.MonkeyPatch.context() as patch:
        old = os.environ.get("PYTHONPATH")
        patch.setenv("PYTHONPATH", str(ROOT) if old is None else f"{ROOT}{os.pathsep}{old}")
        yield
