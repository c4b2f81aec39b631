"""Exit codes 0 and 1 are for runs that were judged: whatever a user's code raises, it is 3."""

import importlib
import json
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as Xml

import pytest

from pemviz.cli.main import main
from tests.comparable_results import comparable, comparable_result

ROOT = Path(__file__).resolve().parents[2]
MODULE = '''
"""A simulator of a third party with a fault that can be removed: by a file beside it."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

from pemviz.simulators.braking.vectorized import VectorizedSimulator

FAULT = Path(__file__).with_name("fault.txt")


class Odd(BaseException):
    pass


def do(fault):
    if fault == "once" and not FAULT.with_name("was").exists():
        FAULT.with_name("was").touch()
        os._exit(0)
    if fault.startswith("exit"):
        sys.exit(int(fault[-1]))
    if fault == "interrupt":
        raise KeyboardInterrupt
    if fault == "odd":
        raise Odd("neither")
    if fault == "error":
        raise ValueError("wheel fell off")


@dataclass(frozen=True)
class Faulty(VectorizedSimulator):
    @property
    def name(self):
        return "faulty"

    def step(self, states, detected):
        if FAULT.read_text() == "early":
            raise ValueError("wheel fell off")
        if states.shape[0] > 10 and int(states.step) == 30:
            do(FAULT.read_text())
        return super().step(states, detected)


def build(scenario):
    if FAULT.read_text() == "build":
        sys.exit(0)
    return Faulty(scenario)
'''
WORDS = ["--simulator", "faulty", "--method", "mixture", "--stages", "1", "--rollouts", "40",
         "--final-rollouts", "40", "--no-plan", "--no-recording", "--no-measured-memory",
         "--fail-above", "0.5"]  # fmt: skip
FAULTS = {
    "exit0": "SystemExit", "exit1": "SystemExit", "interrupt": "KeyboardInterrupt", "odd": "Odd",
    "error": "ValueError",
}  # fmt: skip


@pytest.fixture
def fault(tmp_path, monkeypatch):
    """What the third party's simulator does: written to this file."""
    home = tmp_path / "site"
    info = home / "third_party_faults-1.0.dist-info"
    info.mkdir(parents=True)
    (home / "third_party_faults.py").write_text(MODULE, encoding="utf-8")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party-faults\n")
    (info / "entry_points.txt").write_text(
        "[pemviz.simulators]\nfaulty = third_party_faults:build\n"
    )
    monkeypatch.syspath_prepend(home)
    monkeypatch.setattr("pemviz.sampling.rollouts.pooled.PIECE_S", 1e9)  # in pieces above 10
    monkeypatch.setenv("PYTHONPATH", f"{home}:{ROOT}")  # for worker processes
    importlib.invalidate_caches()
    yield home / "fault.txt"
    sys.modules.pop("third_party_faults", None)


def record(tmp_path, *words):
    reports = ["--junit", str(tmp_path / "gate.xml"), "--summary", str(tmp_path / "page.md")]
    return main(["record", *words, *reports, "--json"])


def check_reported(shown, folder, kind):
    """Traceback, then one line with what, where, the folder and how to go on."""
    *traceback, line = shown.err.splitlines()
    traceback = [each for each in traceback if not each.startswith("pemviz: ")]
    assert traceback[0] == "Traceback (most recent call last):"
    assert "third_party_faults.py" in traceback[1]
    assert kind in traceback[-1]
    assert line.startswith(f"pemviz: simulator faulty: step raises {kind} in rollout")
    assert ", step 30 (stage 0)" in line
    assert line.endswith(
        f"what was finished is in {folder}; once the cause is removed, go on with: "
        f"pemviz record --resume {folder}"
    )


@pytest.mark.parametrize(
    ("name", "workers"),
    [
        *((name, ()) for name in FAULTS),
        # a worker tells of either exit in the same words
        *((name, ("--workers", "2")) for name in FAULTS if name != "exit1"),
    ],
)
def test_whatever_a_simulator_raises_is_a_failed_run(name, workers, fault, tmp_path, capsys):
    fault.write_text(name)
    out = ["--out", str(tmp_path / "runs")]
    assert record(tmp_path, *WORDS, *out, *workers) == 3
    shown = capsys.readouterr()
    (folder,) = (tmp_path / "runs").iterdir()
    check_reported(shown, folder, FAULTS[name])
    document = json.loads(shown.out)
    assert document.pop("gate")["exit_code"] == 3
    assert document["status"] == "failed"
    assert FAULTS[name] in document["message"]
    assert comparable(document) == comparable_result(folder)
    suite = Xml.parse(tmp_path / "gate.xml").getroot()  # noqa: S314  our own
    assert suite.get("errors") == "1"
    assert FAULTS[name] in suite.find(".//error").get("message")
    assert FAULTS[name] in (tmp_path / "page.md").read_text()

    assert record(tmp_path, "--resume", str(folder), "--fail-above", "0.5") == 3
    check_reported(capsys.readouterr(), folder, FAULTS[name])
    if workers or name != "exit0":
        return
    fault.write_text("none")
    resumed = record(tmp_path, "--resume", str(folder), "--no-recording", "--fail-above", "0.5")
    went_on = json.loads(capsys.readouterr().out)
    assert record(tmp_path, *WORDS, "--out", str(tmp_path / "whole")) == resumed
    (whole,) = (tmp_path / "whole").iterdir()
    undisturbed = json.loads(capsys.readouterr().out)
    for each in (went_on, undisturbed):
        del each["run_id"], each["timings_s"]
    assert went_on == undisturbed
    for file in ("rollouts.npz", "proposals.safetensors"):
        assert (folder / file).read_bytes() == (whole / file).read_bytes()


def test_what_is_raised_in_the_trial_before_a_run_comes_with_its_lines(fault, tmp_path, capsys):
    fault.write_text("early")
    assert record(tmp_path, *WORDS, "--out", str(tmp_path / "runs")) == 2
    first, at, line, *_, last = capsys.readouterr().err.splitlines()
    assert first.startswith("Traceback")
    assert "third_party_faults.py" in at
    assert line.strip() == 'raise ValueError("wheel fell off")'
    assert last.startswith("pemviz: simulator 'faulty': step")
    assert last.endswith("raises ValueError: wheel fell off")
    assert not (tmp_path / "runs").exists()


def test_an_exit_while_the_simulator_is_built_is_bad_input(fault, tmp_path, capsys):
    fault.write_text("build")
    assert record(tmp_path, *WORDS, "--out", str(tmp_path / "runs")) == 2
    shown = capsys.readouterr().err
    assert shown == "pemviz: simulator = 'faulty': third_party_faults:build raises SystemExit: 0\n"


@pytest.mark.parametrize(
    ("source", "code", "words"),
    [
        ("import sys; sys.exit(0)", 2, "cannot be imported: SystemExit: 0"),
        ("import sys\ndef MODEL(): sys.exit(1)", 2, "cannot be imported: SystemExit: 1"),
    ],
)
def test_an_exit_while_an_error_model_is_imported_is_bad_input(
    source, code, words, fault, tmp_path, capsys
):
    (fault.parent / "exiting_model.py").write_text(source)
    try:
        pem = ["--pem", "exiting_model:MODEL", "--allow-python"]
        assert main(["record", "--out", str(tmp_path / "runs"), *pem]) == code
    finally:
        sys.modules.pop("exiting_model", None)
    shown = capsys.readouterr().err
    assert words in shown
    assert shown.count("\n") == 1


def test_a_sweep_marks_the_run_and_does_the_rest(fault, tmp_path, capsys):
    fault.write_text("exit0")
    config = tmp_path / "tiny.toml"
    config.write_text(
        'method = "naive"\nfinal_rollouts = 20\nseed = 3\nplan = false\nreference = false\n'
        "measured_memory = false\n"
    )
    varied = ["--vary", "simulator=faulty,vectorized", "--workers", "1", "--json"]
    assert main(["sweep", str(config), *varied, "--out", str(tmp_path / "out")]) == 3
    by_simulator = {row["simulator"]: row for row in json.loads(capsys.readouterr().out)["runs"]}
    assert by_simulator["vectorized"]["status"] == "done"
    assert by_simulator["faulty"]["status"] == "failed"
    assert "raises SystemExit in rollouts 0 to 19, step 30" in by_simulator["faulty"]["message"]


@pytest.mark.parametrize("raised", [SystemExit(0), SystemExit(1), ZeroDivisionError("x")])
def test_no_command_ends_with_the_exit_code_of_something_it_called(raised, monkeypatch, capsys):
    def fails(words):
        raise raised

    monkeypatch.setattr("pemviz.cli.open.run", fails)
    assert main(["open", "anything"]) == 3
    assert capsys.readouterr().err.splitlines()[-1].startswith("pemviz: open failed: ")


def test_help_ends_with_0():
    command = [sys.executable, "-m", "pemviz", "record", "--help"]
    assert subprocess.run(command, capture_output=True, cwd=ROOT, check=False).returncode == 0


def test_an_abort_says_where_it_was():
    """Of a simulator's library, say: the process ends at once, and no more can be told."""
    lines = (
        "import os",
        "from pemviz.cli import main",
        "main.run_command = lambda *words: os.abort()",
        "main.main(['record'])",
    )
    call = [sys.executable, "-c", "\n".join(lines)]
    ended = subprocess.run(call, check=False, capture_output=True, text=True)
    assert ended.returncode == -signal.SIGABRT
    assert ended.stderr.startswith("Fatal Python error: Aborted")
    assert 'File "<string>", line 3' in ended.stderr


def test_what_ends_a_process_is_survived_without_being_asked_for(fault, tmp_path, capsys):
    """Not even an exit code of 0 stands for the run's."""
    documents = []
    for name in ("none", "once"):
        fault.write_text(name)
        out = str(tmp_path / name)
        assert record(tmp_path, *WORDS, "--out", out) in (0, 1, 4)
        shown = capsys.readouterr()
        documents.append(comparable(json.loads(shown.out)))
        assert ("worker processes that were lost: 1" in shown.err) == (name == "once")
    assert {**documents[0], "run_id": ""} == {**documents[1], "run_id": ""}
