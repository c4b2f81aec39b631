import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import scale
from benchmarks.__main__ import main
from benchmarks.scale import ScaleRow, ScaleStudy, cells, reasons, run_scale

ROOT = Path(__file__).resolve().parents[2]


def test_a_case_is_measured_in_a_process_of_its_own(capsys):
    ballast = np.ones(50_000_000)  # 400 MB that must not count as the case's
    assert main(["scale", "--cases", "50x20", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["scale"]
    del ballast
    steps = 50 * 19
    assert (row["rollouts"], row["states"], row["skipped"]) == (50, 20, "")
    assert row["run_ns_per_step"] * steps == pytest.approx(1e9 * row["run_s"])
    assert 0.0 < row["simulation_ns_per_step"] < row["run_ns_per_step"]
    assert 50.0 < row["peak_mb"] < 380.0
    assert row["disk_mb"] > 50 * (3 * 20 + 2 * 19) * 8 / 1e6
    sparing = ["scale", "--cases", "50x20", "--keep", "violations"]
    assert main([*sparing, "--json"]) == 0
    (less,) = json.loads(capsys.readouterr().out)["scale"]
    assert less["disk_mb"] < row["disk_mb"]


HELD = """
import numpy as np
from benchmarks.scale_case import peak_memory_bytes
before = peak_memory_bytes()
held = np.ones(before // 8 + 25_000_000)
assert peak_memory_bytes() >= before + 150_000_000
del held
assert peak_memory_bytes() >= before + 150_000_000
"""


def test_peak_memory_sees_what_was_held():
    """In a process of its own: this one's peak may be gigabytes, which would have to be held."""
    subprocess.run([sys.executable, "-c", HELD], check=True, cwd=ROOT)


def test_what_cannot_run_says_why(monkeypatch):
    monkeypatch.setattr(scale, "DISK_BYTES_PER_STEP", {"all": 1e18, "violations": 0.0})
    (row,) = run_scale(ScaleStudy(cases=("50x20",)))
    assert row.run_s is None
    assert row.skipped.startswith("needs ")
    assert cells(row) == ("50", "20", "-", "-", "-", "-", "-")
    assert reasons([row]) == [f"50 rollouts of 20: skipped, {row.skipped}"]


def test_the_part_shows_the_same_table(monkeypatch, capsys):
    row = ScaleRow(
        rollouts=1000, states=100, run_s=2.0, run_ns_per_step=20_202.0,
        simulation_ns_per_step=300.4, peak_mb=220.0, disk_mb=4.0,
    )  # fmt: skip
    monkeypatch.setattr("benchmarks.__main__.run_scale", lambda study: iter([row]))
    assert main(["--part", "scale"]) == 0
    assert "20,202" in capsys.readouterr().out
    assert main(["--part", "scale", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scale"][0]["peak_mb"] == 220.0


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (["--cases", "1000"], "cases = '1000'"),
        (["--cases", "1x100"], "both from 2"),
        (["--cases", "100x1"], "both from 2"),
    ],
)
def test_bad_input_is_one_line(capsys, words, fragment):
    assert main(["scale", *words]) == 2
    shown = capsys.readouterr()
    assert fragment in shown.err
    assert shown.err.count("\n") == 1


def test_a_case_that_fails_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert main(["scale", "--cases", "50x20"]) == 3
    shown = capsys.readouterr()
    assert "case of 50 rollouts: exit code 1" in shown.err
    assert shown.err.count("\n") == 1
