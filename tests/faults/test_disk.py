"""Disks that are full, folders that cannot be written: one line, and nothing finished is lost."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from pemviz.cli.main import main
from pemviz.errors import EXIT_DONE, EXIT_FAILED
from pemviz.runs.rollout_files import load_rollouts
from tests.faults.test_resume import contents

ROOT = Path(__file__).resolve().parents[2]
CONFIG = """\
method = "mixture"
stages = 2
rollouts = 40
final_rollouts = 200
measured_memory = false
plan = false
"""
LARGEST_FILE = 600_000  # a stage of 40 rollouts takes 0.2 MB, the final one 1 MB


def record(*words, full=False):
    def fill_the_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST_FILE, LARGEST_FILE))

    return subprocess.run(
        [sys.executable, "-m", "pemviz", "record", *words],
        check=False,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=fill_the_disk if full else None,
    )


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text(CONFIG)
    return str(path)


def only_run(out):
    (folder,) = (path for path in out.iterdir() if path.is_dir())
    return folder


def test_a_full_disk_ends_the_run_and_loses_no_finished_stage(tmp_path, config):
    out, whole = tmp_path / "out", tmp_path / "whole"
    ended = record("--config", config, "--out", str(out), "--no-recording", full=True)
    assert ended.returncode == EXIT_FAILED
    assert "Traceback" not in ended.stderr
    assert "File too large" in ended.stderr.splitlines()[-1]
    folder = only_run(out)
    document = json.loads((folder / "result.json").read_text())
    assert document["status"] == "failed"
    # the last was simulated and counted, but its rollouts could not be kept
    assert [stage["stage"] for stage in document["stages"]] == [0, 1, 2, 3]
    assert sorted(set(load_rollouts(folder)["stage"])) == [0, 1, 2]
    assert list(folder.rglob(".*partial")) == []
    assert main(["record", "--resume", str(folder), "--no-recording"]) == EXIT_DONE
    assert main(["record", "--config", config, "--out", str(whole), "--no-recording"]) == EXIT_DONE
    found, expected = contents(folder), contents(only_run(whole))
    for one in (found, expected):  # names tell the second that a run began in
        assert one["result"].pop("run_id").endswith("-mixture")
    assert found == expected


@pytest.mark.slow
def test_a_recording_that_cannot_be_written_is_told_in_one_line(tmp_path, config):
    ended = record("--config", config, "--out", str(tmp_path / "out"), "--no-frames", full=True)
    assert ended.returncode == EXIT_FAILED
    last = ended.stderr.splitlines()[-1]
    assert last.startswith("pemviz: ")
    assert "run.rrd: cannot be written" in last
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("place", ["/proc/runs", "/dev/null/runs", "{file}/runs"])
def test_a_place_that_cannot_hold_runs_is_bad_input(place, config, capsys):
    where = place.format(file=config)
    assert main(["record", "--config", config, "--out", where]) == 2
    shown = capsys.readouterr().err
    assert shown.count("\n") == 1
    assert where in shown
