"""Rollouts as CSV and Parquet hold what the run folder holds, under its own ranks."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from pyarrow import parquet

import pemviz
from pemviz.cli.main import main
from pemviz.export.formats import METADATA, csv_bytes, parquet_bytes
from pemviz.runs.kept_rollout import read_kept_rollout
from pemviz.runs.ranking import ranked_rows
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.run_folder import record
from tests.export.conftest import RULES
from tests.latent_toys import Drift
from tests.runs import test_rules
from tests.toy import constant_pem


def read_csv(content):
    return list(csv.DictReader(io.StringIO(content.decode("utf-8"))))


@pytest.mark.parametrize(
    "changes",
    [
        {"method": "mixture", "stages": 2, "rollouts": 60, "final_rollouts": 80, "repetitions": 2},
        {"method": "splitting", "stages": 6, "rollouts": 40, "repetitions": 2},
        {"method": "subset", "stages": 6, "rollouts": 40, "repetitions": 2},
        {"method": "monte-carlo", "final_rollouts": 50},
    ],
    ids=lambda changes: changes["method"],
)
def test_ranks_are_those_of_the_result(changes, tmp_path):
    config = replace(test_rules.CONFIG, plan=False, **changes)
    result = record(test_rules.experiment_of(config), tmp_path)
    table = load_rollouts(tmp_path)
    order = ranked_rows(table, result.stages)
    assert sorted(order) == list(range(len(table["violated"])))
    assert len(result.least_robust) == 20
    for rank, listed in enumerate(result.least_robust, start=1):
        found = read_kept_rollout(tmp_path, rank=rank)
        assert (found.repetition, found.stage, found.rollout) == (
            listed.repetition, listed.stage, listed.rollout
        )  # fmt: skip
        assert (found.robustness, found.violated) == (listed.robustness, listed.violated)
        assert tuple(name for name, broken in found.broken.items() if broken) == listed.broken


def test_a_table_of_ones_own_simulator_holds_signals_rules_and_every_slot(slots_run):
    rollouts = load_rollouts(slots_run)
    rank = 5
    row = ranked_rows(rollouts, pemviz.read_result(slots_run).stages)[rank - 1]
    rollout = read_kept_rollout(slots_run, rank=rank)
    rows = read_csv(csv_bytes(rollout))
    table = parquet.read_table(io.BytesIO(parquet_bytes(rollout)))
    assert table.column_names == list(rows[0])
    step_s = pemviz.read_result(slots_run).simulator.dt_s
    assert table["time_s"].to_pylist() == [step * step_s for step in range(len(rows))]
    for name in ("speed_m", "gap_m"):
        assert [float(one[name]) for one in rows] == rollouts[name][row].tolist()
        assert table[name].to_pylist() == rollouts[name][row].tolist()
    for place, slot in enumerate(("car", "ghost")):
        for name in ("detected", "log_p", "log_q"):
            expected = rollouts[name][row, :, place].tolist()
            assert table[f"{name}.{slot}"].to_pylist() == [*expected, None]
            cells = [one[f"{name}.{slot}"] for one in rows]
            assert [json.loads(cell) for cell in cells[:-1]] == expected
            assert cells[-1] == ""
    for name in RULES:
        assert table[f"broken.{name}"].to_pylist() == [rollouts[f"broken.{name}"][row]] * 16
    settings = json.loads(table.schema.metadata[METADATA])
    assert settings["rules"] == RULES
    assert settings["memory_s"] == 0.2


def test_latents_stand_in_columns_of_their_own(tmp_path):
    drift = Drift(miss_m=0.1)
    config = pemviz.ExperimentConfig(
        method="naive", final_rollouts=30, spec=drift.spec(1.0), plan=False
    )
    pem = constant_pem(detection_probability=0.5)
    result = record(pemviz.build_experiment(config, simulator=drift, pem=pem), tmp_path)
    first, kept = result.least_robust[0], load_rollouts(tmp_path)
    rows = read_csv(csv_bytes(read_kept_rollout(tmp_path, rank=1)))
    start, noise = (kept[f"latents.{name}"][first.rollout] for name in ("start", "noise"))
    assert [float(row["latents.start.0"]) for row in rows] == [*start] * 17
    assert [row["latents.noise.0"] for row in rows] == [*map(repr, noise[:, 0].tolist()), ""]
    assert {row["latents.noise_mean.0"] for row in rows} == {"0.0", ""}
    assert [row["latents.noise_share"] for row in rows] == ["1.0"] * 16 + [""]
    assert "latents.noise_share.0" not in rows[0]
    assert {row["latents.start_log_weight"] for row in rows} == {"0.0"}
    distance_m = [float(row["distance_m"]) for row in rows]
    missed = np.array([row["detected"] == "false" for row in rows[:-1]])
    np.testing.assert_allclose(np.diff(distance_m), 0.1 * missed + 0.2 * noise[:, 0], atol=1e-12)


def test_the_shipped_scenario_has_times(sample_run):
    rows = read_csv(csv_bytes(read_kept_rollout(sample_run, rank=1)))
    times_s = [float(row["time_s"]) for row in rows]
    np.testing.assert_allclose(times_s, 0.05 * np.arange(70), atol=1e-12)


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_the_same_run_gives_the_same_bytes(form, slots_run, tmp_path):
    outs = [tmp_path / f"{name}.{form}" for name in ("one", "two")]
    for out in outs:
        assert main(["export", str(slots_run), "--format", form, "--out", str(out)]) == 0
    assert outs[0].read_bytes() == outs[1].read_bytes()
