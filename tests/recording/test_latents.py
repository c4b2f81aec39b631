"""What was random in the least robust rollouts is in the recording: errors, starts, visibility."""

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr

import pemviz
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import load_preset
from pemviz.recording import paths
from pemviz.runs.experiment import build_experiment
from tests.latent_toys import Drift, Flat
from tests.recording.conftest import record, scalars, texts


def titles(recorded):
    """Of the views in the recording's layout."""
    reader = rr.chunk.RrdReader(recorded.path)
    stored = [c.to_record_batch() for c in reader.stream(store=reader.blueprints()[-1])]
    name = "ViewBlueprint:display_name"
    rows = [
        row for batch in stored if name in batch.schema.names for row in batch[name].to_pylist()
    ]
    return [title for row in rows for title in row]


def by_step(recorded):
    """What was random at each step of the least robust rollout, ``[T-1, M]``."""
    rows = scalars(recorded.path, paths.WORST_NOISE, paths.STEP)
    return np.array([rows[step] for step in sorted(rows)])


def rank_one(recorded):
    ranked = recorded.result.least_robust[0]
    return ranked.rollout, recorded.stages[ranked.stage].scored.rollouts


@pytest.fixture(scope="module")
def braking(tmp_path_factory):
    """Errors of the measured gap and obstacles that differ: experiment and record."""
    config = ExperimentConfig(
        method="monte-carlo", final_rollouts=10, position_errors="pointpillars", plan=False,
        spec="always[0,99] (gap >= 9.0)", seed=2, frailty=0.4,
    )  # fmt: skip
    experiment = build_experiment(config)
    return experiment, record(experiment, tmp_path_factory.mktemp("braking"))


def test_errors_are_what_the_controller_measured_less_the_truth(braking):
    """Step by step, from the rollout's own latents."""
    experiment, recorded = braking
    row, rollouts = rank_one(recorded)
    simulator = experiment.declared.scenario
    latents = rollouts.latents.take(np.array([row]))
    states = simulator.initial(count=1, start=latents.start)
    measured = []
    for step in range(simulator.states - 1):
        gap_m, _ = simulator.perceived_gap(states, latents.noise[:, step])
        measured.append(float(gap_m[0] - states.signals["gap"][0]))
        states = simulator.step(states, rollouts.detected[[row], step], latents.noise[:, step])
    np.testing.assert_allclose(by_step(recorded)[:, 0], measured, atol=1e-9)
    assert np.ptp(measured) > 0.1
    assert "Rank 1: error of measured places [m] against step" in titles(recorded)


def test_the_table_tells_starts_and_how_hard_the_obstacle_is_to_see(braking):
    _, recorded = braking
    row, rollouts = rank_one(recorded)
    table = texts(recorded.path)[paths.WORST_SUMMARY].split("## Random at the start")[1]
    first = next(line for line in table.splitlines() if line.startswith("| 1 |"))
    assert f"latent 0 at {rollouts.latents.start[row, 0]:.3g}" in first
    assert f"visibility u in the end {rollouts.signals['visibility'][row, -1]:.3g}" in first


def test_a_logical_scenario_tells_of_every_car_and_names_its_start(tmp_path):
    config = replace(
        load_preset("cut-in"), method="monte-carlo", final_rollouts=10,
        position_errors="pointpillars", plan=False,
    )  # fmt: skip
    experiment = build_experiment(config)
    recorded = record(experiment, tmp_path)
    row, rollouts = rank_one(recorded)
    found, scenario = by_step(recorded), experiment.declared
    signals = {name: values[[row], :-1] for name, values in rollouts.signals.items()}
    present = scenario.present(signals)[0]
    np.testing.assert_array_equal(np.isnan(found), ~np.repeat(present, 2, axis=-1))
    assert found.shape == (scenario.states - 1, 2 * len(scenario.slots))
    gap_m = float(scenario.start_values(rollouts.latents.start[[row]])["gap"][0])
    assert f"gap {gap_m:.3g} m" in texts(recorded.path)[paths.WORST_SUMMARY]


def test_latents_that_nobody_explains_are_shown_as_they_are(tmp_path):
    drift = Drift(miss_m=0.4)
    config = ExperimentConfig(
        method="monte-carlo", final_rollouts=30, spec=drift.spec(1.0), plan=False
    )
    recorded = record(pemviz.build_experiment(config, simulator=drift, pem=Flat(0.1)), tmp_path)
    row, rollouts = rank_one(recorded)
    np.testing.assert_array_equal(by_step(recorded), rollouts.latents.noise[row])
    assert "Rank 1: standard normals against step" in titles(recorded)


def test_without_latents_nothing_is_said_of_them(learned):
    assert "Random at the start" not in texts(learned.path)[paths.WORST_SUMMARY]
    assert not any(title.startswith("Rank 1:") for title in titles(learned))
