"""Damaged inputs end a command with exit code 2 and one line on standard error."""

import shutil

import pytest

from pemviz.cli.main import main
from pemviz.files.shipped import sample_run

LONG = "x" * 300


@pytest.fixture
def damaged(tmp_path, monkeypatch):
    """A folder with a damaged file of every kind, made the current one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.toml").write_text("alpha = 0.1\nseed = " + "9" * 5000)
    (tmp_path / "pem.safetensors").write_bytes(b"\xff" * 40)
    (tmp_path / "pem.csv").write_text("distance_m,p_detected\n1,\x00\n")
    (tmp_path / "run.rrd").write_bytes(b"\0" * 100)
    (tmp_path / "table.csv").write_text("a,b\n1,2\n")
    for name in ("labels", "found"):
        (tmp_path / name).mkdir()
    (tmp_path / "labels" / "000000.txt").write_text("Car 0 0\n")
    (tmp_path / "found" / "000000.txt").write_text("")
    run = tmp_path / "run"
    shutil.copytree(sample_run(), run)
    (run / "run.rrd").write_bytes(b"RR")
    (run / "result.json").write_text("[" * 100_000)
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        "record --config config.toml",
        f"record --config {LONG}",
        "record --config labels",
        "record --pem pem.safetensors",
        "record --pem pem.csv",
        f"record --pem {LONG}",
        f"record --pem {LONG}.safetensors",
        "record --pem run.rrd",
        "record --resume run",
        "open run",
        "open run.rrd",
        "open run/result.json",
        f"open {LONG}",
        "pem collect --labels labels --detections found --out out.csv",
        f"pem collect --labels {LONG} --detections found --out out.csv",
        f"pem collect --labels labels --detections {LONG} --out out.csv",
        "pem evaluate --table table.csv",
        f"pem evaluate --table {LONG}",
        "pem fit --table table.csv --out out.safetensors",
        f"pem fit --table table.csv --out {LONG}/out.safetensors",
        "pem show pem.safetensors",
        "pem show pem.csv",
        f"pem show --ensemble {LONG}",
    ],
)
def test_one_line_and_exit_code_2(damaged, capsys, words):
    before = sorted(damaged.rglob("*"))
    assert main(words.split()) == 2
    streams = capsys.readouterr()
    (line,) = streams.err.splitlines()
    assert line.startswith("pemviz: ")
    assert line.isprintable()
    assert streams.out == ""
    assert [p for p in sorted(damaged.rglob("*")) if p.name != ".lock"] == before


def test_a_result_that_cannot_be_written_is_told_before_and_after(damaged, capsys, monkeypatch):
    table = "z.csv"
    monkeypatch.setattr("pemviz.cli.pem.fit.load_table", lambda path, features: _table())
    words = f"pem fit --table {table} --model guess-mu --folds 0 --out {'y' * 240}.safetensors"
    assert main(words.split()) == 2
    assert "cannot be written" in capsys.readouterr().err
    monkeypatch.setattr("pemviz.cli.pem.evaluate.load_table", lambda path, features: _table())
    assert main(f"pem evaluate --table z --models guess-mu --out {LONG}".split()) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_full_disk_is_told_in_one_line(capsys, monkeypatch):
    def full(name, words):
        raise OSError(28, "No space left on device", "recordings/x")

    monkeypatch.setattr("pemviz.cli.main.run_command", full)
    assert main(["record"]) == 3
    assert capsys.readouterr().err == "pemviz: No space left on device (recordings/x)\n"


def _table():
    from studies.synthetic_obstacles import synthetic_table  # noqa: PLC0415

    return synthetic_table(obstacles=60, seed=1)
