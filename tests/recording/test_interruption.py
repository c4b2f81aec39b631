"""A recording survives a kill, a failure and a scenario of one's own."""

import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from pemviz.errors import InputError, RunError
from pemviz.recording import Recorder, paths
from pemviz.recording.open import free_port
from pemviz.runs.engine import run
from pemviz.runs.events import StageDone
from pemviz.runs.experiment import build_experiment
from tests.recording.conftest import LEARNING, with_blind_pem
from tests.recording.read_back import chunks, read_stages, texts
from tests.recording.test_values import verify
from tests.toy import MissCounter, constant_pem

ROOT = Path(__file__).resolve().parents[2]

KILLED_RUN = """
import os, signal, sys
from pathlib import Path
from pemviz.config import ExperimentConfig
from pemviz.runs.engine import run_experiment
from pemviz.runs.events import StageDone
from pemviz.recording import Recorder

class Killer:
    def notify(self, event):
        if isinstance(event, StageDone) and event.stage.stage == 2:
            os.kill(os.getpid(), signal.SIGKILL)

run_experiment(
    ExperimentConfig(method="adaptive", stages=3, rollouts=20, final_rollouts=20, epochs=2,
    measured_memory=False),
    observers=[Recorder(Path(sys.argv[1])), Killer()],
)
"""


def test_finished_stages_of_a_killed_run_are_readable(tmp_path):
    path = tmp_path / "run.rrd"
    done = subprocess.run(
        [sys.executable, "-c", KILLED_RUN, str(path)], capture_output=True, cwd=ROOT, check=False
    )
    assert done.returncode == -9, done.stderr
    found = read_stages(path)
    assert sorted(found) == [0, 1, 2]
    for stage in found.values():
        assert stage.series["gap_m"].shape == (20, 100)
        assert stage.detected.shape == (20, 99)
    assert paths.stage_curve(2) in {chunk.entity_path for chunk in chunks(path)}
    assert "Stages done so far: 3." in texts(path)[paths.ANSWER]


def test_a_failed_run_leaves_a_whole_file_that_says_why(tmp_path):
    experiment = with_blind_pem(LEARNING)
    calls = iter(range(100))

    def robustness(signals):
        if next(calls) == 2:  # one a stage, as those on the twin come at the end
            raise ValueError("the metric broke")
        return np.min(signals["gap"], axis=1) - 2.0

    broken = replace(experiment, problem=replace(experiment.problem, robustness=robustness))
    path = tmp_path / "run.rrd"
    with pytest.raises(RunError):
        run(broken, observers=[Recorder(path)])
    assert verify(path).returncode == 0
    assert sorted(read_stages(path)) == [0, 1]
    assert "the metric broke" in texts(path)[paths.WARNINGS]


def test_a_file_that_cannot_be_written_is_one_line(tmp_path):
    experiment = with_blind_pem(replace(LEARNING, method="naive"))
    with pytest.raises(RunError) as caught:
        run(experiment, observers=[Recorder(tmp_path / "nowhere" / "run.rrd")])
    assert "nowhere" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_recording_is_one_line(tmp_path):
    path = tmp_path / "run.rrd"
    path.write_bytes(b"not a recording")
    with pytest.raises(InputError) as caught:
        read_stages(path)
    assert "\n" not in str(caught.value)


def test_another_simulator_is_recorded_without_the_scene(tmp_path):
    experiment = build_experiment(replace(LEARNING, method="naive", final_rollouts=40))
    problem = replace(
        experiment.problem,
        simulator=MissCounter(states=7),
        pem=constant_pem(detection_probability=0.9),
        robustness=lambda signals: np.min(signals["gap"], axis=1),
        violated=lambda signals: np.min(signals["gap"], axis=1) < 0.0,
    )
    path = tmp_path / "run.rrd"
    alone = replace(experiment.back_end, twin=None)
    run(
        replace(experiment, problem=problem, back_end=alone, ensemble=None, model_classes=()),
        observers=[Recorder(path)],
    )
    assert verify(path).returncode == 0
    assert read_stages(path)[0].series["gap_m"].shape == (40, 7)
    logged = {chunk.entity_path for chunk in chunks(path)}
    assert not any(entity.startswith(paths.SCENE) for entity in logged)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a disk that is full")
def test_a_full_disk_is_one_line():
    experiment = with_blind_pem(replace(LEARNING, method="naive"))
    with pytest.raises(RunError, match="cannot be written") as caught:
        run(experiment, observers=[Recorder(Path("/dev/full"))])
    assert "\n" not in str(caught.value)


def test_a_live_viewer_can_connect_from_this_machine_only(tmp_path):
    ports = []

    class Look:
        def notify(self, event):
            if isinstance(event, StageDone):
                ports.extend(
                    (connection.laddr.ip, connection.laddr.port)
                    for connection in psutil.Process().net_connections(kind="inet")
                    if connection.status == psutil.CONN_LISTEN
                )

    port = free_port()
    path = tmp_path / "run.rrd"
    experiment = with_blind_pem(replace(LEARNING, method="naive"))
    run(experiment, observers=[Recorder(path, live_port=port), Look()])
    assert ("127.0.0.1", port) in ports
    assert verify(path).returncode == 0


def test_a_taken_live_port_is_one_line(tmp_path):
    experiment = with_blind_pem(replace(LEARNING, method="naive"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(RunError, match=f"live port {port}") as caught:
            run(experiment, observers=[Recorder(tmp_path / "run.rrd", live_port=port)])
    assert "\n" not in str(caught.value)
