"""No name leads out of the recordings folder; damaged runs are told in one line."""

import os
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from pemviz.config.toml_files import load_config
from pemviz.errors import InputError
from pemviz.files.shipped import sample_run
from pemviz.panel.app import show_something
from pemviz.panel.loading import LoadedRuns, load_run
from pemviz.panel.recordings_folder import RecordingsFolder, Viewers
from pemviz.panel.rollout_tables import check_table
from pemviz.runs.reading import read_result
from pemviz.runs.result_file import write_result
from pemviz.runs.rollout_files import load_rollouts, part_path, write_part
from pemviz.runs.run_folder import run_lock
from tests.comparable_results import without_digests

CRAFTED = (
    "..", ".", "", "/", "../outside", "run/../../outside", "/etc", "run/", "./run", "run\x00",
    "link", "..\\outside", "%2e%2e/outside", "outside",
)  # fmt: skip


@pytest.fixture
def folder(tmp_path, kept) -> RecordingsFolder:
    root = tmp_path / "recordings"
    shutil.copytree(kept[0], root / "run")
    shutil.copytree(kept[0], tmp_path / "outside")
    (root / "link").symlink_to(tmp_path / "outside")
    (root / "empty").mkdir()
    (root / "note.txt").write_text("not a run")
    return RecordingsFolder(root)


def test_only_run_folders_are_listed(folder):
    assert folder.names() == ["run"]
    (entry,) = folder.entries()
    shown = [entry.name, *(entry.summary[name] for name in ("status", "method", "seed"))]
    assert shown == ["run", "done", "adaptive", 5]
    assert not entry.has_recording


@pytest.mark.parametrize("name", CRAFTED)
def test_crafted_names_are_refused(folder, name):
    with pytest.raises(InputError, match="is not in the recordings folder"):
        folder.folder(name)
    with pytest.raises(InputError, match="is not in the recordings folder"):
        folder.content(name, "result.json")


def test_a_link_within_a_run_is_not_followed(folder, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("x")
    (folder.root / "run" / "run.rrd").symlink_to(secret)
    with pytest.raises(InputError, match=r"has no run\.rrd"):
        folder.content("run", "run.rrd")


def test_content_is_the_file(folder):
    path = folder.root / "run" / "result.json"
    assert folder.content("run", "result.json") == path.read_bytes()


def test_a_folder_that_is_not_there_is_empty(tmp_path):
    assert RecordingsFolder(tmp_path / "absent").entries() == []


def test_a_rewritten_result_is_read_again(folder):
    assert folder.entries()[0].summary["status"] == "done"
    path = folder.root / "run" / "result.json"
    write_result(path.parent, replace(read_result(path.parent), status="stopped"))
    os.utime(path, (1, 1))
    assert folder.entries()[0].summary["status"] == "stopped"


def damage_json(run: Path):
    (run / "result.json").write_text("[1, 2")


def damage_table(run: Path):
    (run / "rollouts.npz").write_bytes(b"PK\x03\x04 nothing")


def damage_proposals(run: Path):
    (run / "proposals.safetensors").write_bytes(b"\xff" * 64)


def no_config(run: Path):
    (run / "config.toml").unlink()


def other_config(run: Path):
    path = run / "config.toml"
    path.write_text(path.read_text().replace("seed = 5", "seed = 6", 1))


def edit(run: Path, **changes):
    """Change arrays of a run's rollouts; ``None`` takes one away."""
    table = load_rollouts(run)
    table |= {name: change(table[name]) for name, change in changes.items() if change}
    gone = {name for name, change in changes.items() if change is None}
    np.savez(run / "rollouts.npz", **{k: v for k, v in table.items() if k not in gone})


@pytest.mark.parametrize(
    "damage",
    [
        damage_json,
        damage_table,
        lambda run: edit(run, detected=None),
        lambda run: edit(run, gap_m=lambda values: values[:, :-1]),
        lambda run: edit(run, gap_m=lambda values: np.array([{"a": 1}], dtype=object)),
        damage_proposals,
        no_config,
        other_config,
    ],
)
def test_damage_is_one_line(folder, damage):
    run = folder.root / "run"
    damage(run)
    with pytest.raises(InputError) as caught:
        load_run(run)
    assert "\n" not in str(caught.value)


def first_is(value):
    def change(array):
        array = array.copy()
        array.flat[0] = value
        return array

    return change


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("gap_m", first_is(np.nan), "between -1e\\+09 and 1e\\+09"),
        ("gap_m", first_is(1e300), "between -1e\\+09 and 1e\\+09"),
        ("log_p", first_is(0.1), "logarithms of probabilities"),
        ("log_q", first_is(-np.inf), "logarithms of probabilities"),
        ("robustness", first_is(np.nan), "not NaN"),
        ("stage", first_is(-1), "between 0 and"),
        ("repetition", first_is(2**62), "between 0 and"),
        ("detected", lambda array: array.astype(np.float64), "must hold truth values"),
        ("violated", lambda array: array[:-1], "must have shape"),
    ],
)
def test_rollouts_with_impossible_numbers_are_refused(folder, name, change, words):
    run = folder.root / "run"
    edit(run, **{name: change})
    config = load_config(run / "config.toml")
    with pytest.raises(InputError, match=words):
        check_table(load_rollouts(run), config, where=str(run))
    with pytest.raises(InputError):  # what it is that a result contradicts, is told first
        load_run(run)


def test_stages_that_hold_different_arrays_are_refused(folder):
    run = folder.root / "run"
    paths = [part_path(run, repetition=0, stage=stage) for stage in range(2)]
    names = [path.name for path in paths]
    with np.load(run / "rollouts.npz") as arrays:
        write_part(paths[0], dict(arrays))
    write_part(paths[1], {"gap_m": np.zeros(3)})
    with pytest.raises(InputError, match=rf"{names[1]}: must hold the same arrays as {names[0]}"):
        load_run(run)


def test_proposals_that_overflow_are_not_drawn(folder):
    run = folder.root / "run"
    path = run / "proposals.safetensors"
    save_file({name: np.full_like(a, 1e200) for name, a in load_file(path).items()}, path)
    without_digests(run)
    # the rollouts tell what was sampled from
    assert all(np.nanmax(curve.detection) <= 1.0 for curve in load_run(run).curves)


def test_notes_are_kept_in_the_folder_and_shown_again(folder):
    assert folder.notes("run") == ""
    folder.note("run", "tyres: cold\nsecond line")
    assert (folder.root / "run" / "notes.txt").read_text() == "tyres: cold\nsecond line"
    assert folder.entries()[0].notes == folder.notes("run") == "tyres: cold\nsecond line"
    folder.note("run", " ")
    assert not (folder.root / "run" / "notes.txt").exists()
    with pytest.raises(InputError, match="must be at most 20,000"):
        folder.note("run", "x" * 20_001)
    with pytest.raises(InputError, match="is not in the recordings folder"):
        folder.note("../outside", "x")


def test_notes_that_lead_elsewhere_are_not_read(folder, tmp_path):
    (tmp_path / "secret").write_text("x")
    (folder.root / "run" / "notes.txt").symlink_to(tmp_path / "secret")
    assert folder.notes("run") == ""
    folder.note("run", "mine")
    assert (tmp_path / "secret").read_text() == "x"


def test_a_deleted_run_can_be_brought_back_until_it_is_forgotten(folder, tmp_path):
    (folder.root / "run" / "outside").symlink_to(tmp_path / "outside")
    folder.set_aside("run")
    assert folder.names() == []
    folder.put_back("run")
    assert folder.names() == ["run"]
    folder.set_aside("run")
    folder.forget()
    assert sorted(p.name for p in folder.root.iterdir()) == ["empty", "link", "note.txt"]
    assert (tmp_path / "outside" / "result.json").exists()
    with pytest.raises(InputError, match="is not in the recordings folder"):
        folder.set_aside("run")
    with pytest.raises(InputError, match="cannot be brought back"):
        folder.put_back("run")


def test_a_run_at_work_is_not_deleted(folder):
    with run_lock(folder.root / "run"), pytest.raises(InputError, match="is at work in it"):
        folder.set_aside("run")
    assert folder.names() == ["run"]


def test_the_list_says_what_is_damaged(folder, kept):
    for name, damage in (("bad", damage_json), ("worse", no_config)):
        shutil.copytree(kept[0], folder.root / name)
        damage(folder.root / name)
    assert [entry.name for entry in folder.entries()] == ["run"]
    damaged = "\n".join(folder.damaged())
    assert f"{Path('bad') / 'result.json'}: cannot be read" in damaged
    assert f"{Path('worse') / 'config.toml'}: cannot be read" in damaged
    assert len(folder.damaged()) == 2


def test_a_run_without_rollouts_or_proposals_still_shows(folder):
    run = folder.root / "run"
    (run / "rollouts.npz").unlink()
    (run / "proposals.safetensors").unlink()
    loaded = load_run(run)
    assert loaded.kept == 0
    assert loaded.curves == ()


def test_curves_come_from_the_rollouts_where_no_proposal_is_kept(folder):
    run = folder.root / "run"
    exact = {curve.stage: curve for curve in load_run(run).curves}
    (run / "proposals.safetensors").unlink()
    visited = load_run(run).curves
    # what stage 3 was drawn from is what stage 2 learned; bins of 0.25 m blur a little
    (drawn,) = (curve for curve in visited if curve.stage == 3)
    known = np.isfinite(drawn.detection)
    assert np.count_nonzero(known) > 50
    difference = np.abs(drawn.detection - exact[2].detection)[known]
    assert np.max(difference) < 0.05


def test_the_sample_is_a_run_if_it_is_shipped():
    sample = sample_run()
    assert sample is not None
    assert load_run(sample).kept > 0


def test_browsers_share_a_loaded_run_until_it_changes(folder):
    runs = LoadedRuns()
    run = folder.root / "run"
    first = runs.get(run)
    assert runs.get(run) is first
    os.utime(run / "result.json", (1, 1))
    assert runs.get(run) is not first
    with pytest.raises(InputError, match="cannot be read"):
        runs.get(folder.root / "absent")


def test_a_viewer_is_opened_once_and_the_oldest_is_closed():
    opened, closed = [], []

    @contextmanager
    def viewer(path):
        opened.append(path)
        yield f"http://127.0.0.1/{path}"
        closed.append(path)

    viewers = Viewers(viewer, limit=2)
    one, two, three = Path("1"), Path("2"), Path("3")
    assert viewers.open(one) == viewers.open(one) == "http://127.0.0.1/1"
    assert opened == [one]
    viewers.open(two)
    viewers.open(three)
    assert closed == [one]
    viewers.close()
    assert closed == [one, two, three]
    assert viewers.open(one) == "http://127.0.0.1/1"


def test_ones_own_newest_run_is_shown_first_and_the_shipped_one_where_there_is_none(tmp_path):
    shown = []
    controller = SimpleNamespace(show=lambda run: shown.append(run.folder.name), start=None)
    show_something(controller, RecordingsFolder(tmp_path))
    for name in ("20260101-120000-auto", "20260102-120000-auto", "sample"):
        shutil.copytree(sample_run(), tmp_path / name)
    show_something(controller, RecordingsFolder(tmp_path))
    (tmp_path / "20260102-120000-auto" / "result.json").write_text("{}")
    show_something(controller, RecordingsFolder(tmp_path))
    assert shown == [sample_run().name, "20260102-120000-auto", "20260101-120000-auto"]
