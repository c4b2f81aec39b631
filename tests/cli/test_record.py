import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pemviz.cli.main import main
from tests.comparable_results import comparable, comparable_result

ROOT = Path(__file__).resolve().parents[2]
QUICK = ["--stages", "1", "--rollouts", "20", "--final-rollouts", "20", "--epochs", "2",
         "--no-plan", "--no-recording", "--no-measured-memory"]  # fmt: skip


def record(tmp_path, *words):
    return main(["record", "--out", str(tmp_path / "runs"), *QUICK, *words])


def test_record_writes_a_run_folder_and_a_summary(tmp_path, capsys):
    assert record(tmp_path) == 0
    shown = capsys.readouterr()
    (folder,) = (tmp_path / "runs").iterdir()
    assert (folder / "result.json").exists()
    assert str(folder.name) in shown.out.replace("\n", "")
    assert "probability" in shown.out
    assert "stage 1" in shown.err


def test_the_reference_stands_in_the_summary(tmp_path, capsys):
    words = ["--method", "naive", "--final-rollouts", "200", "--reference"]
    words += ["--scenario.states", "40", "--spec", "always[0,39] (gap >= 9.0)", "--json"]
    assert record(tmp_path, *words) == 0
    known = json.loads(capsys.readouterr().out)["reference"]
    assert record(tmp_path, *words[:-1]) == 0
    shown = capsys.readouterr().out
    assert f"{known['probability']:.4g} +- {known['std_error']:.1g}" in shown


def test_json_is_one_object_and_nothing_else(tmp_path, capsys):
    assert record(tmp_path, "--json", "--method", "naive") == 0
    shown = capsys.readouterr()
    document = json.loads(shown.out)
    (folder,) = (tmp_path / "runs").iterdir()
    assert comparable(document) == comparable_result(folder)
    assert document["estimate"]["method"] == "naive"


def test_a_runs_config_runs_again_to_the_same_estimate(tmp_path, capsys):
    assert record(tmp_path, "--json", "--seed", "3") == 0
    first = json.loads(capsys.readouterr().out)
    (folder,) = (tmp_path / "runs").iterdir()
    words = ["--config", str(folder / "config.toml"), "--json", "--no-recording"]
    assert main(["record", "--out", str(tmp_path / "again"), *words]) == 0
    second = json.loads(capsys.readouterr().out)
    assert first["estimate"] == second["estimate"]
    assert first["stages"] == second["stages"]
    assert first["config"] == second["config"]


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (["--sigma", "1.2"], ["sigma = 1.2", "at least 0.95 and below 1"]),
        (["--alpha", "two"], ["--alpha", "two"]),
        (["--alpha", "nan"], ["alpha = nan", "at least 0 and at most 1"]),
        (["--alhpa", "0.2"], ["--alhpa", "--alpha"]),
        (["--stages", "0"], ["stages = 0", "at least 1 and at most 1000"]),
        (["--method", "magic"], ["magic", "monte-carlo"]),
        (["--preset", "moon"], ["preset = 'moon'", "paper, paper-algorithm, town01"]),
        (["--preset", "paper", "--config", "x.toml"], ["give only one"]),
        (["--config", "absent.toml"], ["absent.toml", "cannot be read"]),
        (["--spec", "always[0,99] gap >="], ["spec"]),
        (["--spec", "always[0,99] (speed >= 2)"], ["speed"]),
        (["--spec", "always[5,2] (gap >= 2)"], ["5", "2"]),
        (["--pem", "nowhere.safetensors"], ["nowhere.safetensors"]),
        (["--fail-above", "0"], ["fail-above = 0", "above 0 and at most 1"]),
        (["--scenario.dt-s", "0"], ["scenario.dt_s = 0", "at least 0.001"]),
        (["--seed", "-1"], ["seed = -1"]),
        (["surplus"], ["surplus"]),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, capsys, words, fragments):
    assert record(tmp_path, *words) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert shown.err.startswith("pemviz: ")
    for fragment in fragments:
        assert fragment in shown.err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("words", [["recrod"], ["--nonsense"]])
def test_an_unknown_command_is_named(capsys, words):
    assert main(words) == 2
    assert words[0] in capsys.readouterr().err


def test_overview_and_version(capsys):
    assert main(["--help"]) == 0
    assert "record" in capsys.readouterr().out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("pemviz ")


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--method", "monte-carlo", "--fail-above", "0.9"], 0),
        (["--method", "monte-carlo", "--fail-above", "1e-6"], 1),
        (["--method", "naive", "--fail-above", "1e-9"], 4),  # a few weights carry it
        (["--method", "naive", "--naive-detection-probability", "0.999", "--fail-above", "0.5"], 4),
    ],
)
def test_the_gate_never_passes_in_silence(tmp_path, capsys, words, code):
    assert record(tmp_path, *words) == code
    assert "gate" in capsys.readouterr().err


def test_an_unwritable_place_is_bad_input(tmp_path, capsys):
    (tmp_path / "runs").write_text("a file is in the way")
    assert record(tmp_path) == 2
    assert "runs" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_run_and_keeps_what_is_done(tmp_path, number):
    words = ["record", "--out", str(tmp_path), "--no-recording", "--stages", "500",
             "--rollouts", "20", "--epochs", "2"]  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-m", "pemviz", *words],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("*/stages/*.npz")):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(number)
    _, complaint = process.communicate(timeout=30)
    assert process.returncode == 3
    (folder,) = tmp_path.iterdir()
    assert "pemviz: stopped; what was finished is in " in complaint
    assert f"go on with: pemviz record --resume {folder}\n" in complaint
    document = json.loads((folder / "result.json").read_text())
    assert document["status"] == "stopped"
    assert len(document["stages"]) >= 1
    assert (folder / "rollouts.npz").exists()
