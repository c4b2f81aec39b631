"""Systems of one's own that say nothing of cars: their signals stand in the place of a scene."""

import importlib

import numpy as np
import pytest

import pemviz
from pemviz.panel.loading import load_run
from pemviz.panel.ranking import rank
from tests.own_systems import BLIND, DRONE, PEMS, RULES, register
from tests.panel.test_saved_charts import asked, figures, of


@pytest.fixture(scope="module")
def registered(tmp_path_factory):
    """Runs of registered systems in folders, by name."""
    root = tmp_path_factory.mktemp("own")
    register(root / "site")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(root / "site")
        importlib.invalidate_caches()
        for name, pem in PEMS.items():
            config = pemviz.ExperimentConfig(
                simulator=name, method="naive", spec=RULES[name], final_rollouts=60, plan=False
            )
            experiment = pemviz.build_experiment(config, pem=pem)
            (root / name).mkdir()
            pemviz.record(experiment, root / name)
        yield {name: load_run(root / name) for name in PEMS}


def least_robust(run):
    found = asked(run, "rollout", among="all", first="least robust", rank=1, height=300)
    return found, int(rank(run, run.config.metric, among="all").order[0])


def test_each_signal_is_drawn_over_time_with_the_misses_of_the_rollout(registered):
    run = registered[DRONE]
    opened = asked(run, "open")
    assert opened["scene"] is False
    assert "in the place of a scene" in opened["scene_words"]
    found, index = least_robust(run)
    distance, approach = (next(iter(figures(chart["html"]).values())) for chart in found["stage"])
    table = {name: values[index] for name, values in run.rollouts.items()}
    missed = np.flatnonzero(~table["detected"])
    assert 0 < missed.size < 60
    assert found["misses"] == missed.tolist()
    for columns, series, head, key in (
        (distance, "distance", "distance [m]", "distance_m"),
        (approach, "approach", "approach [m/s]", "approach_mps"),
    ):
        np.testing.assert_array_equal(of(columns, series, head), table[key])
        np.testing.assert_array_equal(of(columns, "missed", head), table[key][missed])
        np.testing.assert_allclose(of(columns, series, "time [s]"), 0.1 * np.arange(61), atol=1e-12)
    assert of(distance, "0.3 m: limit", "distance [m]") == [0.3]
    readings = {one["name"]: one for one in found["readings"]}
    assert {name: one["unit"] for name, one in readings.items()} == {
        "distance": "m", "approach": "m/s",
    }  # fmt: skip
    np.testing.assert_allclose(readings["distance"]["values"], table["distance_m"], rtol=1e-3)
    (perception,) = found["charts"]
    outcomes = next(iter(figures(perception["html"]).values()))
    np.testing.assert_allclose(of(outcomes, "missed", "time [s]"), 0.1 * missed, atol=1e-12)
    assert found["contact"] is None
    assert asked(run, "scene_page", rank=1) is None


def test_several_slots_are_told_apart_without_a_scene_too(registered):
    run = registered[BLIND]
    found, index = least_robust(run)
    assert len(found["stage"]) == len(run.simulator.signals) == 7
    table = {name: values[index] for name, values in run.rollouts.items()}
    states = {name: values[0] for name, values in run.signals(index).items()}
    present = run.simulator.present(states)[:-1]
    wrong = present & ~table["detected"]
    assert found["misses"] == np.flatnonzero(wrong.any(axis=1)).tolist()
    outcomes = next(iter(figures(found["charts"][0]["html"]).values()))
    told = list(zip(outcomes["series"], outcomes["about"], strict=True))
    for place, slot in enumerate(("lead", "cutter")):
        assert told.count(("error", slot)) == wrong[:, place].sum() > 0


def test_charts_share_the_time_axis_and_fill_the_place_that_there_is(registered):
    for name, run in registered.items():
        found, _ = least_robust(run)
        spans = {(one["left"], one["right"]) for one in found["stage"]}
        assert len(spans) == 1, name
    drone, _ = least_robust(registered[DRONE])
    taller = asked(registered[DRONE], "rollout", among="all", rank=1, height=600)
    for low, tall in zip(drone["stage"], taller["stage"], strict=True):
        assert tall["bottom"] - low["bottom"] == 150


def test_all_pages_of_such_a_run_are_there(registered):
    for run in registered.values():
        for page in ("learning", "weights", "why", "metrics", "uncertainty"):
            assert len(asked(run, "page", page=page)["html"]) > 200
