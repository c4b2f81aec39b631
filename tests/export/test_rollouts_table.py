"""All rollouts of a run as one table: rows that can be told apart, and weights that add up."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

import pemviz
from pemviz.config import ExperimentConfig
from pemviz.runs.experiment import build_experiment
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.run_folder import record
from tests.latent_toys import Drift
from tests.lattice_walk import ToyPem, ToySimulator
from tests.toy import ConstantPem

OFTEN = ToySimulator(initial_gap=2, states=12), ToyPem(at_zero=1.0)
RARE = ToySimulator(initial_gap=4, states=14), ToyPem(at_zero=2.0)
SMALL = ExperimentConfig(stages=3, rollouts=60, final_rollouts=80, seed=4, repetitions=2)


def kept(folder, system, method, **settings):
    simulator, pem = system
    spec = f"always[0,{simulator.states - 1}] (gap >= 0.5)"
    config = replace(SMALL, method=method, spec=spec, **settings)
    return record(build_experiment(config, simulator=simulator, pem=pem), folder)


@pytest.mark.parametrize("keep", ["all", "violations"])
@pytest.mark.parametrize(
    ("method", "system"),
    [
        ("auto", OFTEN),
        ("auto", RARE),
        ("mixture", RARE),
        ("monte-carlo", OFTEN),
        ("naive", OFTEN),
        ("adaptive", RARE),
    ],
)
def test_weights_of_violations_add_up_to_the_answer(method, system, keep, tmp_path):
    result = kept(tmp_path, system, method, keep=keep)
    table = pemviz.read_rollouts(tmp_path)
    violated = np.array(table["violated"])
    weight = np.exp(np.array(table["log_weight"])[violated])
    assert result.estimate.failures > 0
    assert np.nansum(weight) == pytest.approx(result.estimate.probability, rel=1e-12)


def test_rows_are_the_rollouts_with_their_places_and_what_they_did(tmp_path):
    result = kept(tmp_path, RARE, "mixture")
    table, arrays = pemviz.read_rollouts(tmp_path), load_rollouts(tmp_path)
    assert isinstance(table, pa.Table)
    assert table.num_rows == sum(stage.rollouts for stage in result.stages)
    places = list(
        zip(*(table[n].to_pylist() for n in ("repetition", "stage", "rollout")), strict=True)
    )
    wanted = [(s.repetition, s.stage, n) for s in result.stages for n in range(s.rollouts)]
    assert places == wanted
    for name in ("gap_m", "detected", "log_p"):
        assert table[name].to_pylist() == arrays[name].tolist()
    first = result.least_robust[0]
    row = places.index((first.repetition, first.stage, first.rollout))
    assert table["robustness"][row].as_py() == first.robustness


def test_numbers_of_rollouts_that_are_kept_alone_are_those_in_their_stage(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    kept(tmp_path / "a", OFTEN, "monte-carlo")
    kept(tmp_path / "b", OFTEN, "monte-carlo", keep="violations")
    everything, some = (pemviz.read_rollouts(tmp_path / name) for name in "ab")
    by_place = {tuple(row[n] for n in ("repetition", "stage", "rollout")): row["gap_m"]
                for row in everything.to_pylist()}  # fmt: skip
    assert 0 < some.num_rows < everything.num_rows
    for row in some.to_pylist():
        assert by_place[row["repetition"], row["stage"], row["rollout"]] == row["gap_m"]


def test_latents_are_lists_and_answers_that_are_no_sum_have_no_weights(tmp_path):
    drift = Drift(states=9)
    spec = "eventually[8,8] (distance <= 1.5)"
    config = replace(SMALL, method="subset", spec=spec, repetitions=3)
    record(build_experiment(config, simulator=drift, pem=ConstantPem(0.5)), tmp_path)
    table = pemviz.read_rollouts(tmp_path)
    assert "log_weight" not in table.column_names
    noise = np.array(table["latents.noise"].to_pylist())
    assert noise.shape[:2] == (table.num_rows, 8)


def test_what_there_is_not_is_refused(tmp_path):
    with pytest.raises(pemviz.InputError, match=r"config\.toml|result\.json"):
        pemviz.read_rollouts(tmp_path)
