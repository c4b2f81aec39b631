"""The published schema of result.json describes all that is written, and nothing else."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from jsonschema import Draft202012Validator

from docs._ext.result_schema import result_schema
from examples import random_start
from pemviz.config import EncounterConfig, ExperimentConfig, ScenarioConfig
from pemviz.files.shipped import sample_run
from pemviz.runs.engine import run, run_experiment
from pemviz.runs.experiment import build_experiment
from pemviz.runs.result_file import RESULT_FILE, result_document
from pemviz.runs.run_folder import RunStore
from tests.runs.results import results

PUBLISHED = Path(__file__).resolve().parents[2] / "docs" / "reference" / "result.schema.json"
SCHEMA = result_schema()
VALIDATOR = Draft202012Validator(SCHEMA)
TINY = ExperimentConfig(
    method="adaptive", stages=1, rollouts=20, final_rollouts=30, epochs=2, seed=3,
    spec="always[0,11] (gap >= 2.0)", scenario=ScenarioConfig(states=12, dt_s=0.4),
    measured_memory=False,
)  # fmt: skip
ENCOUNTER = ExperimentConfig(
    method="mixture",
    stages=1,
    rollouts=20,
    final_rollouts=20,
    epochs=2,
    seed=3,
    chains=0,
    encounter=EncounterConfig(logical_scenario="cut-in", states=31, neighbour=True),
    measured_memory=False,
).with_rules({"far": "always[0,30] (gap_lead >= 2)", "slow": "always[0,30] (ego_speed <= 40)"})
CONFIGS = {
    "adaptive": TINY,
    "splitting": replace(TINY, method="splitting", repetitions=2),
    "infinitely robust": replace(TINY, method="naive", spec="true"),
    "all that a run can tell": replace(
        TINY, method="mixture", reference=True, target=1e-20, plan=True, measured_memory=True,
        encounters_per_hour=3.0,
    ),
    "memory and position errors": replace(
        TINY, method="mixture", pem="rrc", position_errors="pointpillars"
    ),
    "logical scenario with rules": ENCOUNTER,
}  # fmt: skip


def complaints(document):
    return [
        f"{error.json_path}: {error.message[:200]}" for error in VALIDATOR.iter_errors(document)
    ]


def kept(folder):
    return json.loads((folder / RESULT_FILE).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def sample():
    return kept(sample_run())


def test_what_is_published_is_the_schema_of_what_is_written():
    """``python docs/_ext/result_schema.py > docs/reference/result.schema.json`` brings it up."""
    Draft202012Validator.check_schema(SCHEMA)
    assert json.loads(PUBLISHED.read_text(encoding="utf-8")) == SCHEMA


def test_the_sample_fits(sample):
    assert complaints(sample) == []


@pytest.mark.parametrize("name", CONFIGS)
def test_what_runs_write_fits(name, tmp_path):
    result = run_experiment(CONFIGS[name], observers=[RunStore(tmp_path)])
    assert result.status == "done"
    assert complaints(kept(tmp_path)) == []
    assert complaints(result_document(result)) == []


def test_what_a_run_of_ones_own_system_writes_fits(tmp_path):
    config = replace(TINY, method="mixture", spec="always[0,50] (gap >= 0.0)")
    experiment = build_experiment(
        replace(config, scenario=ScenarioConfig()),
        simulator=random_start.StandingCar(),
        pem=random_start.Camera(),
    )
    result = run(experiment, observers=[RunStore(tmp_path)])
    assert {"simulator", "latents", "starts"} <= set(kept(tmp_path))
    assert result.status == "done"
    assert complaints(kept(tmp_path)) == []


def test_what_a_stopped_run_leaves_fits(tmp_path):
    result = run_experiment(TINY, observers=[RunStore(tmp_path)], should_stop=lambda: True)
    assert result.status == "stopped"
    assert complaints(kept(tmp_path)) == []


@settings(max_examples=100, deadline=None)
@given(results())
def test_any_result_fits(result):
    assert complaints(result_document(result)) == []


def test_every_entry_is_described():
    undescribed = [
        f"{name}.{field}"
        for name, kind in {"": SCHEMA, **SCHEMA["$defs"]}.items()
        for field, schema in kind["properties"].items()
        if not schema.get("description")
    ]
    assert undescribed == []


@pytest.mark.parametrize(
    "path", [(), ("estimate",), ("estimate", "unbiased"), ("config",), ("stages", 0), ("plan",)]
)
def test_an_entry_that_the_schema_does_not_name_is_refused(sample, path):
    document = copy.deepcopy(sample)
    table = document
    for key in path:
        table = table[key]
    table["new"] = 1
    assert len(complaints(document)) == 1


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("estimate", "probability"), -0.1),
        (("estimate", "failures"), 1.5),
        (("status",), "finished"),
        (("digest",), "abc"),
        (("config", "seed"), None),
        (("schema",), 3),
    ],
)
def test_a_wrong_value_is_refused(sample, path, value):
    document = copy.deepcopy(sample)
    *outer, last = path
    table = document
    for key in outer:
        table = table[key]
    table[last] = value
    assert complaints(document) != []


def test_digests_belong_to_schema_2_alone(sample):
    without = {name: entry for name, entry in sample.items() if name not in ("files", "digest")}
    assert complaints(without) != []
    assert complaints({**without, "schema": 1}) == []
    assert complaints({**sample, "schema": 1}) != []
