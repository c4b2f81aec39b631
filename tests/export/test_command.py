"""What ``pemviz export`` cannot do is told in one line, with exit code 2."""

import shutil

import numpy as np
import pytest

from pemviz.cli.main import main
from pemviz.export import formats
from pemviz.runs.kept_rollout import UNDATED, read_kept_rollout
from tests.comparable_results import without_digests


def refused(words, capsys):
    """The one line."""
    assert main(["export", *words]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    return line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--format", "csv", "--rank", "178"], "rank = 178: must be a whole number from 1 to 177"),
        (["--format", "csv", "--rank", "0"], "rank = 0: must be a whole number, at least 1"),
        (["--format", "xml"], "--format"),
        ([], "--format"),
        (["--format", "csv", "--out", "nowhere/one.csv"], "must lie in a folder that exists"),
        (["--format", "csv", "--out", "folder.csv"], "must be a file, is a folder"),
        (["--format", "csv", "--out", "there.csv"], "is there already; --force replaces it"),
        (["--format", "csv", "--out", "one"], "must be a file name with an ending"),
        (["--format", "csv", "--out", f"{'o' * 300}.csv"], "cannot be written"),
    ],
)
def test_bad_input_is_one_line(words, message, sample_run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "there.csv").write_text("kept")
    assert message in refused([str(sample_run), *words], capsys)
    assert (tmp_path / "there.csv").read_text() == "kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.csv", "there.csv"]


def test_a_road_that_is_there_is_not_replaced_either(sample_run, tmp_path, capsys):
    pytest.importorskip("scenariogeneration", reason="needs the extra pemviz[export]")
    out = tmp_path / "one.xosc"
    out.with_suffix(".xodr").write_text("kept")
    words = [str(sample_run), "--format", "openscenario", "--out", str(out)]
    assert "one.xodr: is there already" in refused(words, capsys)
    assert not out.exists()
    assert main(["export", *words, "--force"]) == 0
    assert out.with_suffix(".xodr").read_text() != "kept"


def test_a_folder_without_rollouts_is_refused(sample_run, tmp_path, capsys):
    for name in ("config.toml", "result.json"):
        shutil.copy(sample_run / name, tmp_path)
    without_digests(tmp_path)
    words = [str(tmp_path), "--format", "csv", "--out", str(tmp_path / "one.csv")]
    assert "has no rollouts" in refused(words, capsys)
    assert "there is no such folder" in refused([str(tmp_path / "none"), *words[1:]], capsys)
    rollouts = dict(np.load(sample_run / "rollouts.npz"))
    np.savez(tmp_path / "rollouts.npz", **rollouts | {"gap_m": rollouts["gap_m"][:, :-1]})
    assert "gap_m has shape (177, 69), must have (177, 70)" in refused(words, capsys)
    np.savez(tmp_path / "rollouts.npz", **rollouts | {"gap_m": rollouts["gap_m"] * np.nan})
    if formats.find_spec("scenariogeneration"):
        words[2] = "openscenario"
        assert "what is no gap or speed" in refused(words, capsys)


@pytest.mark.parametrize("form", ["openscenario", "commonroad"])
def test_ones_own_simulator_has_tables_alone(form, slots_run, tmp_path, capsys, monkeypatch):
    words = [str(slots_run), "--format", form, "--out", str(tmp_path / "one.file")]
    if formats.find_spec(formats.FORMATS[form].module):
        assert "simulator 'ghost-brake'; take csv or parquet" in refused(words, capsys)
    monkeypatch.setattr(formats, "find_spec", lambda name: None)
    assert "install it with pip install 'pemviz[export]'" in refused(words, capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", ["openscenario", "commonroad"])
def test_runs_with_a_memory_have_cars_too(form, memory_run, tmp_path):
    """They keep what perception remembers as further signals."""
    pytest.importorskip(formats.FORMATS[form].module, reason="needs the extra pemviz[export]")
    assert len(read_kept_rollout(memory_run, rank=1).signals) == 6
    words = ["--format", form, "--out", str(tmp_path / "one.file")]
    assert main(["export", str(memory_run), *words]) == 0


def test_a_file_is_dated_by_its_run(sample_run, tmp_path):
    assert read_kept_rollout(sample_run, rank=1).date == UNDATED
    shutil.copytree(sample_run, tmp_path / "run")
    without_digests(tmp_path / "run")
    path = tmp_path / "run" / "result.json"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('"run_id": "sample"', '"run_id": "20261122-153400-mixture-2"'))
    assert read_kept_rollout(tmp_path / "run", rank=1).date.isoformat() == (
        "2026-11-22T15:34:00+00:00"
    )
