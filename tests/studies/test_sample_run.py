"""The committed sample: still opens, has the current layout, and runs again to its estimate."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from pemviz.config.toml_files import config_from_table, load_config
from pemviz.errors import InputError
from pemviz.files import shipped
from pemviz.runs.result_file import SCHEMA
from pemviz.runs.rollout_files import load_rollouts
from studies.sample_run import MOST_BYTES, folder_bytes, make_sample, sample_config
from tests.recording.read_back import chunks

ROOT = Path(__file__).resolve().parents[2]
HOW = "run `python -m studies.sample_run` and commit the result"


@pytest.fixture(scope="module")
def sample():
    found = shipped.sample_run()
    assert found is not None
    return found


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fresh")
    make_sample(folder)
    return folder


def shape_of(value):
    """The keys of a document, all the way down; of a list, its first entry's."""
    if isinstance(value, dict):
        return {key: shape_of(item) for key, item in value.items()}
    if isinstance(value, list):
        return [shape_of(value[0])] if value and isinstance(value[0], dict) else "list"
    return "value"


def result_of(folder):
    return json.loads((folder / "result.json").read_text(encoding="utf-8"))


def entities(folder):
    return {chunk.entity_path for chunk in chunks(folder / "run.rrd")}


def test_it_is_small_and_complete(sample, fresh):
    assert folder_bytes(sample) <= MOST_BYTES
    names = {path.name for path in sample.iterdir()}
    assert names == {path.name for path in fresh.iterdir()}, HOW
    assert "run.rrd" in names


def test_its_configuration_is_the_scripts(sample):
    assert load_config(sample / "config.toml") == sample_config(), HOW


def test_its_result_has_the_current_layout(sample, fresh):
    ours, current = result_of(sample), result_of(fresh)
    assert ours["schema"] == SCHEMA
    assert ours["status"] == "done"
    ours["versions"] = current["versions"] = {}
    assert shape_of(ours) == shape_of(current), HOW
    assert ours["estimate"]["failures"] > 0


def test_its_arrays_have_the_current_layout(sample, fresh):
    ours, current = load_rollouts(sample), load_rollouts(fresh)
    layout = {name: (array.shape, array.dtype) for name, array in ours.items()}
    assert layout == {name: (array.shape, array.dtype) for name, array in current.items()}, HOW
    tensors, new = (load_file(f / "proposals.safetensors") for f in (sample, fresh))
    assert {n: t.shape for n, t in tensors.items()} == {n: t.shape for n, t in new.items()}, HOW


def test_its_recording_opens_and_has_the_current_entities(sample, fresh):
    assert entities(sample) == entities(fresh), HOW


def test_its_recording_holds_its_own_configuration(sample):
    (text,) = [
        column.to_pylist()[0][0]
        for chunk in chunks(sample / "run.rrd")
        if chunk.entity_path == "/config/config_toml"
        for field, column in zip(
            chunk.to_record_batch().schema, chunk.to_record_batch().columns, strict=True
        )
        if field.name.endswith(":text")
    ]
    toml = text.split("```toml\n")[1].split("```")[0] if "```toml" in text else text
    assert config_from_table(tomllib.loads(toml)) == sample_config()


def test_its_first_stage_comes_out_the_same_everywhere(sample, fresh):
    """Nothing is learned yet: only rounding could tell machines apart."""
    ours, again = load_rollouts(sample), load_rollouts(fresh)
    first = ours["stage"] == 0
    np.testing.assert_array_equal(ours["detected"][first], again["detected"][first])
    np.testing.assert_allclose(ours["gap_m"][first], again["gap_m"][first], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours["log_p"][first], again["log_p"][first], rtol=1e-6)


def test_running_it_again_gives_its_estimate(sample, fresh):
    """To a factor of 100 only: between machines, learning amplifies the last digit's rounding."""
    ours, again = result_of(sample)["estimate"], result_of(fresh)["estimate"]
    assert again["failures"] > 0
    assert abs(ours["log10_probability"] - again["log10_probability"]) < 2.0


def test_an_installed_wheel_finds_its_copy(tmp_path, monkeypatch):
    (tmp_path / "_sample").mkdir()
    (tmp_path / "_sample" / "result.json").write_text("{}")
    monkeypatch.setattr(shipped.resources, "files", lambda package: tmp_path)
    assert shipped.sample_run() == tmp_path / "_sample"


def test_a_missing_sample_is_none(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped.resources, "files", lambda package: tmp_path)
    monkeypatch.setattr(shipped, "__file__", str(tmp_path / "pemviz" / "files" / "shipped.py"))
    assert shipped.sample_run() is None
    with pytest.raises(InputError, match="shipped files not found: neither "):
        shipped.asset_root()


def test_the_wheel_takes_the_sample_along():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    included = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included["recordings/sample"] == "pemviz/_sample"
