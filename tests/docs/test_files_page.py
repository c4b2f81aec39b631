"""The page of files names what is in the files of the shipped run, and of the shipped models."""

import re
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open

from pemviz.files.shipped import asset_path, sample_run
from pemviz.pem.model_files import shipped_pems, shipped_position_errors
from pemviz.recording import paths
from tests.recording.read_back import chunks

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "files.md"


@pytest.fixture(scope="module")
def named():
    """What stands in code on the page."""
    return re.findall(r"`([^`\n]+)`", PAGE.read_text(encoding="utf-8"))


def fits(name, patterns):
    """Whether a name is one of those, in which upper-case words stand for something."""
    told = (re.escape(one) for one in patterns if re.search("[a-z]", one))
    return any(
        re.fullmatch(re.sub(r"\\\.\\\.\\\.|[A-Z]+", r"[\\w./-]+", one), name) for one in told
    )


def test_arrays_of_rollouts(named):
    with np.load(sample_run() / "rollouts.npz") as rollouts:
        missing = [name for name in rollouts.files if not fits(name, named)]
    assert missing == []


def test_tensors_of_proposals(named):
    with safe_open(sample_run() / "proposals.safetensors", "numpy") as proposals:
        names = list(proposals.keys())
    assert [name for name in names if not fits(name, named)] == []
    assert {name.rpartition(".")[2] for name in names} <= set(named)


def test_files_of_a_run_folder(named):
    assert {path.name for path in sample_run().iterdir()} <= set(named)


def test_entities_of_a_recording(named):
    there = {str(chunk.entity_path) for chunk in chunks(sample_run() / "run.rrd")}
    shown = {
        path for path in there
        if not path.startswith(("/view", "/container", "/viewport", "/blueprint", "/__"))
        and path not in ("/time_panel", "/selection_panel")
    }  # fmt: skip
    parts = ("/body", "/name", "/outcome", "/pole", "/zone", "/zone/words")
    below = {f"/worst_case/scene/rank_N/car_I{part}" for part in parts}
    legends = {"/learning/proposals/stage_NNN/legend", "/learning/proposals/error_model/legend"}
    known = [*named, *below, *legends]
    assert len(shown) > 50
    assert sorted(path for path in shown if not fits(path, known)) == []
    assert {name for name in named if name.endswith(paths.FIGURES)} >= set(paths.FIGURES)


@pytest.mark.parametrize("model", shipped_pems())
def test_tensors_of_error_models(named, model):
    with safe_open(asset_path("pem", f"{model}.safetensors"), "numpy") as file:
        names, metadata = list(file.keys()), file.metadata()
    assert set(metadata) <= set(named)
    single = {re.sub(r"^members\.\d+\.", "", name) for name in names}
    assert sorted(name for name in single if not fits(name, named)) == []


@pytest.mark.parametrize("model", shipped_position_errors())
def test_tensors_of_position_errors(named, model):
    with safe_open(asset_path("position_errors", f"{model}.safetensors"), "numpy") as file:
        names, metadata = list(file.keys()), file.metadata()
    assert set(metadata) <= set(named)
    assert sorted(name for name in names if not fits(name, named)) == []


def test_a_name_that_is_not_on_the_page_is_found(named):
    assert not fits("log_r", named)
    assert not fits("/worst_case/elsewhere", named)
    assert fits("/rollouts/stage_003/gap_m", named)
