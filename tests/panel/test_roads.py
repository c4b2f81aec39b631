"""Runs of a scenario that tells where its cars are, in the panel."""

import re
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

import pemviz
from pemviz.charts.svg import plot_of, svg
from pemviz.errors import InputError
from pemviz.latents import Latents
from pemviz.panel import loading
from pemviz.panel.compare_page import metrics_page
from pemviz.panel.controller import Watcher
from pemviz.panel.learning_page import learning
from pemviz.panel.ranking import rank, row
from pemviz.panel.rollout_charts import step_words, track, track_charts
from pemviz.panel.rollout_details import details, rule_robustness
from pemviz.panel.rollout_tables import check_table
from pemviz.panel.scene import scene_html
from pemviz.panel.weights_page import heaviest_chart, weights_page
from pemviz.panel.why_page import failures_of, why
from pemviz.runs.drawn_rollout import WRONG
from pemviz.runs.events import StageDone
from pemviz.simulators.slots import UnrolledSimulator
from tests.scene_toys import CameraOfTwo, CutIn

CONFIG = pemviz.ExperimentConfig(
    method="naive", final_rollouts=60, plan=False, spec="always[0,40] (collided <= 0.5)"
)


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A run as it was shown while it went on, its folder and its one stage."""
    folder = tmp_path_factory.mktemp("roads") / "a-run"
    folder.mkdir()
    stages = []
    listener = SimpleNamespace(
        notify=lambda event: stages.append(event.stage) if isinstance(event, StageDone) else None
    )
    watcher = Watcher(folder=folder, publish=lambda *_: None, own=CutIn())
    experiment = pemviz.build_experiment(CONFIG, simulator=CutIn(), pem=CameraOfTwo())
    pemviz.record(experiment, folder, observers=[watcher, listener])
    return SimpleNamespace(run=watcher.run, folder=folder, rollouts=stages[0].scored.rollouts)


def first(run):
    return row(run, rank(run, "classical"), 0)


def test_a_run_read_from_its_folder_shows_what_it_showed_under_way(ran, monkeypatch):
    built = SimpleNamespace(simulator=UnrolledSimulator(CutIn()))
    monkeypatch.setattr(loading, "build_back_end", lambda config: built)
    loaded = loading.load_run(ran.folder)
    assert loaded.own == CutIn()
    assert first(loaded) == first(ran.run)
    again, before = track(loaded, first(loaded)), track(ran.run, first(ran.run))
    np.testing.assert_array_equal(again.drawn.states.x_m, before.drawn.states.x_m)
    np.testing.assert_array_equal(again.answers, before.answers)
    assert drawn_of(again) == drawn_of(before)


def drawn_of(chosen):
    return [svg(chart) for chart in track_charts(chosen, width=300)]


def with_cars(shown, count):
    """The rollout with the car behind the ego there several times, each faster than the last."""
    drawn = shown.drawn
    others = tuple(replace(drawn.cars[1], name=f"the car number {i}") for i in range(1, count))
    pick = [0, *[1] * (count - 1)]
    states = {f.name: getattr(drawn.states, f.name) for f in fields(drawn.states)}
    states = {name: values for name, values in states.items() if values is not None}
    many = {name: v[:, pick] if v.ndim == 2 else v for name, v in states.items()}
    many["speed_mps"] = many["speed_mps"] * np.r_[1.0, 0.5 + 0.1 * np.arange(count - 1)]
    cars = (drawn.cars[0], *others)
    drawn = replace(drawn, cars=cars, states=replace(drawn.states, **many))
    return replace(shown, drawn=drawn)


def test_names_of_many_cars_stand_beneath_the_axis_and_within_the_picture(ran):
    few = track(ran.run, first(ran.run))
    for count in (3, 7):
        _, chart, _ = track_charts(with_cars(few, count), width=300)
        names = re.findall(r"<text x='([\d.]+)' y='([\d.]+)'[^>]*>(the car num[^<]*)", svg(chart))
        plot = plot_of(chart)
        assert len(names) == count - 1
        for x, y, name in names:
            assert float(x) + 5.4 * len(name) < plot.width
            assert plot.bottom + 30 < float(y) < plot.height


def test_tracks_of_a_rollout_are_those_that_its_controller_had(ran):
    entry = first(ran.run)
    tracks, scenario = track(ran.run, entry).drawn.tracks, CutIn()
    memory = {name: v[entry.rollout] for name, v in ran.rollouts.memory.items()}
    kept = scenario.tracker.state(memory, slots=2).confirmed
    assert 0 < kept.sum() < kept.size
    np.testing.assert_array_equal(tracks.confirmed, kept)


def test_errors_of_every_slot_count_and_are_told_at_their_step(ran):
    entry = first(ran.run)
    chosen = track(ran.run, entry)
    assert entry.misses == np.count_nonzero(~ran.rollouts.detected[entry.rollout])
    both = np.flatnonzero((chosen.answers[: chosen.contact_step] == WRONG).all(axis=1))
    assert step_words(chosen, int(both[0])) == "lead MISSED, cutter MISSED"
    assert step_words(chosen, chosen.contact_step) == "after contact"
    page = "".join(drawn_of(chosen))
    for words in ("Perception", ">lead<", ">cutter<", "impact"):
        assert words in page
    failures = failures_of(ran.run)
    violated = ran.run.rollouts["violated"]
    missed = ~ran.rollouts.detected[violated]
    np.testing.assert_array_equal(failures.missed, missed.any(axis=-1))
    seen = 1.0 / (1.0 + np.exp(-ran.rollouts.pem_logit[violated]))
    absent = ~CutIn().present({n: v[violated] for n, v in ran.rollouts.signals.items()})[:, :-1]
    expected = 1.0 - np.where(absent, 1.0, seen).prod(axis=-1)
    np.testing.assert_allclose(failures.pem_miss, expected, atol=1e-12)


def test_every_page_is_drawn_without_a_gap(ran):
    run = ran.run
    assert "Missed in violations, by time" in why(run)
    assert "Missed in violations, by distance" not in why(run)
    assert "No signal of the scenario says how near" in weights_page(run)
    assert heaviest_chart(run).title.startswith("Collided of the rollouts")
    assert ">collided</text>" in metrics_page(run)
    assert learning(run)


def test_a_page_of_the_scene_alone_names_the_cars(ran):
    page = scene_html(track(ran.run, first(ran.run)).drawn)
    assert page.lstrip().lower().startswith("<!doctype html>")


def test_tables_of_another_shape_are_refused(ran):
    table = dict(ran.run.rollouts)
    check_table(table, ran.run.config, where="here", simulator=CutIn())
    table["detected"] = table["detected"][..., 0]
    with pytest.raises(InputError, match=r"detected has shape \(60, 40\), must have .*40, 2\)"):
        check_table(table, ran.run.config, where="here", simulator=CutIn())


RULES = {"touch": "always[0,40] (collided <= 0.5)", "slow": "always[0,40] (ego_speed <= 25)"}


def test_the_rollout_shown_has_the_robustness_of_each_rule_and_its_start_in_words(ran):
    config = ran.run.config.with_rules(RULES)
    table = {**ran.run.rollouts, "broken.touch": ran.run.rollouts["violated"]}
    table["broken.slow"] = np.zeros(60, dtype=np.bool_)
    shown = replace(ran.run, result=replace(ran.run.result, config=config), parts=(table,))
    entry = first(shown)
    fastest = float(np.max(ran.rollouts.signals["ego_speed"][entry.rollout]))
    assert rule_robustness(shown, entry.index) == {"touch": -0.5, "slow": 25.0 - fastest}
    page = details(shown, entry, contact="contact at 1.00 s")
    assert page.index("broken</span>") < page.index("slow") < page.index("kept")
    assert "Contact at 1.00 s." in page
    start = np.array([[0.5]] * 60)
    noise = np.zeros((60, 40, 1))
    still = 0.0 * start
    latents = Latents(start, still, still[:, 0], noise, noise, noise[..., 0], noise + 1.0)
    arrays = {f"latents.{field.name}": getattr(latents, field.name) for field in fields(Latents)}
    kept = {name: values for name, values in arrays.items() if values is not None}
    with_latents = replace(shown, parts=(table | kept,))
    page = details(with_latents, entry)
    assert "Standard normals at its start: 0.5." in page
    assert "Standard normals of its steps" in page
