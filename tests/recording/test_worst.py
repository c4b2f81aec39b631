"""The least robust rollouts: on their roads, on film, with what was random in them."""

from collections import Counter
from dataclasses import replace
from io import BytesIO

import numpy as np
import PIL.Image
import pytest

import pemviz
from pemviz.colors import DETECTED, GREY, MISSED, car_color, rgba
from pemviz.config import ExperimentConfig, StartChoice
from pemviz.config.toml_files import load_preset
from pemviz.recording import paths
from pemviz.recording.scene import OnRoad, row_m
from pemviz.recording.scene_plan import ANGLES
from pemviz.recording.shades import shade
from pemviz.recording.views import FROM_ABOVE
from pemviz.recording.worst import outcome_frame
from pemviz.runs.drawn_rollout import NOT_EVALUATED, RIGHT, WRONG, drawn_rollout, remembered
from pemviz.runs.experiment import build_experiment
from pemviz.simulators.scene import Ramp
from tests.latent_toys import Drift, Flat
from tests.recording.conftest import record, with_blind_pem
from tests.recording.read_back import (
    chunks,
    columns,
    newest,
    scalars,
    strips,
    texts,
    titles,
    values_at,
)
from tests.scene_toys import SPREAD_M, CameraOfTwo, CutIn


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    config = pemviz.ExperimentConfig(
        spec="always[0,40] (collided <= 0.5)", method="naive", final_rollouts=60, plan=False
    )
    experiment = pemviz.build_experiment(config, simulator=CutIn(), pem=CameraOfTwo())
    return record(experiment, tmp_path_factory.mktemp("roads"))


@pytest.fixture(scope="module")
def rollout(recorded):
    """The least robust rollout, as its batch has it."""
    (stage,), ranked = recorded.stages, recorded.result.least_robust[0]
    return stage.scored.rollouts.take(slice(ranked.rollout, ranked.rollout + 1))


def values(recorded, entity, name):
    return columns(recorded.path, entity)[name].to_pylist()


def number(color):
    red, green, blue, opacity = color
    return red << 24 | green << 16 | blue << 8 | opacity


def first_contact(rollout):
    return int(np.flatnonzero(rollout.signals["collided"][0])[0])


def test_every_car_stands_where_the_scenario_says_seen_from_the_ego(recorded, rollout):
    scene = CutIn().scene({name: v[0] for name, v in rollout.signals.items()})
    for car in range(3):
        found = values(recorded, paths.road_car(1, car), "Transform3D:translation")
        expected = np.stack([scene.x_m[:, car] - scene.x_m[:, 0], scene.y_m[:, car] + 1.75], axis=1)
        np.testing.assert_allclose(np.array(found)[:, 0, :2], expected, atol=1e-5)
    turned = values(recorded, paths.road_car(1, 2), "Transform3D:quaternion")
    half = scene.heading_rad[:, 2] / 2
    np.testing.assert_allclose(np.array(turned)[:, 0, 2], np.sin(half), atol=1e-6)


def test_cars_are_grey_and_words_tell_the_impact_from_contact_on(recorded, rollout):
    contact = first_contact(rollout)
    shades = values(recorded, f"{paths.road_car(1, 0)}/body", "Boxes3D:colors")
    red, green, blue, _ = rgba(GREY)
    grey = [red << 24 | green << 16 | blue << 8 | 255] * 2
    assert [shade == grey for shade in shades] == [step >= contact for step in range(41)]
    speed = rollout.signals["impact_speed"][0, contact]
    words = f"contact at {contact * 0.1:.2f} s, impact at {speed:.1f} m/s"
    for path, name in ((paths.lane(1, "words"), "Points3D"), (paths.plan(1), "Points2D")):
        labels = [row[0] for row in values(recorded, path, f"{name}:labels")]
        assert [words in label for label in labels] == [step >= contact for step in range(41)]


def test_marks_and_words_tell_what_perception_told_of_each_car(recorded, rollout):
    contact = first_contact(rollout)
    labels = values(recorded, paths.plan(1), "Points2D:labels")
    lines = values(recorded, paths.plan(1), "LineStrips2D:colors")
    present = CutIn().present(rollout.signals)[0]
    assert not present[:contact].all()
    scene = CutIn().scene({name: v[0] for name, v in rollout.signals.items()})
    names = [car.name for car in CutIn().scene_cars]
    for step in range(contact):
        seen, there = rollout.detected[0, step], present[step]
        expected = [
            "not in view" if not there[slot] else "detected" if seen[slot] else "MISSED"
            for slot in range(2)
        ]
        said = dict(label.partition(": ")[::2] for label in labels[step][1:])
        on_road = scene.present[step]
        answers = ["", *expected]
        assert {name: words.partition(",")[0] for name, words in said.items()} == {
            name: answers[car] for car, name in enumerate(names) if on_road[car]
        }
        # a missed car has a line around it, and a cross of two lines on a light ground
        count = Counter(lines[step])
        cars = Counter(number(rgba(car_color(car))) for car in range(3) if on_road[car])
        for color, words, each in ((MISSED, "MISSED", 3), (DETECTED, "detected", 1)):
            shown = number(shade(color))
            assert count[shown] - cars[shown] == each * expected.count(words)


def test_ellipses_are_two_standard_deviations_around_confirmed_tracks_alone(recorded, rollout):
    tracks = CutIn().scene_tracks(
        pemviz.StateBatch(
            step=np.arange(41),
            signals={name: v[0] for name, v in rollout.signals.items()},
            memory={name: v[0] for name, v in rollout.memory.items()},
        )
    )
    shown = tracks.confirmed & (np.arange(41) < first_contact(rollout))[:, None]
    assert 0 < shown.sum() < shown.size
    found = values(recorded, paths.lane(1, "tracks"), "Ellipsoids3D:half_sizes")
    assert [len(row) for row in found] == shown.sum(axis=1).tolist()
    sizes = np.concatenate([np.array(row)[:, :2] for row in found if row])
    np.testing.assert_allclose(sizes, np.tile(2 * np.array(SPREAD_M), (len(sizes), 1)), rtol=1e-6)
    flat = values(recorded, paths.plan(1), "LineStrips2D:strips")
    ellipses = [[strip for strip in row if len(strip) == len(ANGLES)] for row in flat]
    assert [len(row) for row in ellipses] == shown.sum(axis=1).tolist()


def test_the_least_robust_rollouts_are_each_seen_from_above_and_have_a_tab_of_its_own(recorded):
    ranked = recorded.result.least_robust[:FROM_ABOVE]
    assert len(recorded.result.least_robust) > FROM_ABOVE
    (stage,), scenario = recorded.stages, CutIn()
    for rank, one in enumerate(ranked, start=1):
        row = stage.scored.rollouts.take(slice(one.rollout, one.rollout + 1))
        scene = scenario.scene({name: v[0] for name, v in row.signals.items()})
        labels = values(recorded, paths.plan(rank), "Points2D:labels")
        assert labels[0][0] == f"rank {rank}: robustness {one.robustness:.3g}"
        moved = values(recorded, paths.plan_road(rank), "Transform3D:translation")
        expected = -scene.x_m[:, 0]
        np.testing.assert_allclose(np.array(moved)[:, 0, 0], expected, rtol=1e-6, atol=1e-5)
    tabs = [title for title in titles(recorded.path) if title.isdecimal() or title == "Rank 1"]
    assert sorted(tabs) == sorted(["Rank 1", *map(str, range(2, FROM_ABOVE + 1))])


def test_a_ramp_is_drawn_in_3d_and_from_above_where_it_is(tmp_path):
    ramp = Ramp(x_m=(-20.0, 40.0, 90.0), right_m=(-12.0, -5.25, -5.25), left_m=(-8.5, -1.75, -1.75))
    simulator = type("OnRamp", (CutIn,), {"road": replace(CutIn.road, ramps=(ramp,))})()
    config = pemviz.ExperimentConfig(
        spec="always[0,40] (collided <= 0.5)", method="naive", final_rollouts=10, plan=False
    )
    experiment = pemviz.build_experiment(config, simulator=simulator, pem=CameraOfTwo())
    recorded = record(experiment, tmp_path)
    ground = np.array(newest(recorded.path, "Mesh3D:vertex_positions")[paths.lane(1, "road")])
    x_m, edges_m = np.tile(ramp.x_m, 2), np.array([*ramp.right_m, *ramp.left_m])
    for place in zip(x_m, edges_m + 12.0, strict=True):
        assert np.linalg.norm(ground[:, :2] - place, axis=1).min() < 1e-4
    far = np.array(newest(recorded.path, "Mesh3D:vertex_positions")[paths.lane(2, "road")])
    assert far[:, 1].min() > ground[:, 1].max()
    lines = [strip[:, 0] for strip in strips(recorded.path, paths.plan_road(1))]
    assert sum(line.tolist() == list(ramp.x_m) for line in lines) == 1, "the right edge, all along"


def test_roads_do_not_overlap_and_the_page_says_what_is_drawn(recorded, rollout):
    drawn = drawn_rollout(
        CutIn(),
        signals={name: v[0] for name, v in rollout.signals.items()},
        detected=rollout.detected[0],
        memory={},
    )
    assert drawn.tracks is None
    near, far = (OnRoad(None, drawn, rank, "", None).shift_m for rank in (1, 2))
    edges_m = drawn.road.lane_edges_m
    assert edges_m[-1] + near < edges_m[0] + far
    assert row_m(drawn.road) > 7.0
    assert "where the controller tracks a car" in texts(recorded.path)[paths.CONTENTS]


def test_what_a_tracker_remembers_comes_back_from_outcomes(rollout):
    again = remembered(CutIn(), detected=rollout.detected[0])
    assert set(again) == set(rollout.memory)
    for name, kept in again.items():
        np.testing.assert_array_equal(kept, rollout.memory[name][0])


def test_answers_are_none_where_nothing_is_in_view_and_of_a_ghost_the_other_way_round():
    slots = (pemviz.Slot("lead"), pemviz.Slot("cutter", nominal=False))
    scenario = type("Haunted", (CutIn,), {"slots": slots})()
    signals = {name: v.repeat(3) for name, v in scenario.initial(count=1).signals.items()}
    signals |= {"gap_lead": np.full(3, 30.0), "gap_cutter": np.array([-9.0, 10.0, 10.0])}
    drawn = drawn_rollout(
        scenario, signals=signals, detected=np.array([[True, True], [False, True]]), memory={}
    )
    assert drawn.answers.tolist() == [[RIGHT, NOT_EVALUATED], [WRONG, WRONG]]


def test_a_row_of_outcomes_is_cut_where_its_car_comes_into_view_and_errors_are_those_in_view(
    recorded, rollout
):
    frame = outcome_frame(["rank 1, cutter"] * 4, steps=40, dt_s=0.1)
    present = CutIn().present(rollout.signals)[0, :-1]
    wrong = ~rollout.detected[0] & present
    assert not present.all()
    for slot in range(2):
        drawn = [values_at(frame, line) for line in strips(recorded.path, paths.outcomes(slot + 1))]
        runs = [at_s for at_s, row in drawn if row[0] == row[1]]
        turns_s = (np.flatnonzero(np.diff(present[:, slot])) + 1) * 0.1
        np.testing.assert_allclose([end for _, end in runs], [*turns_s, 4.0], atol=1e-4)
        strokes_s = [at_s[0] for at_s, row in drawn if row[0] != row[1]]
        expected_s = (np.flatnonzero(wrong[:, slot]) + 0.5) * 0.1
        np.testing.assert_allclose(strokes_s, expected_s, atol=1e-4)


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
        seen = simulator.perceived(states, np.array([True]), latents.noise[:, step])
        measured.append(float(seen.gap_m[0] - states.signals["gap"][0]))
        states = simulator.step(states, rollouts.detected[[row], step], latents.noise[:, step])
    np.testing.assert_allclose(by_step(recorded)[:, 0], measured, atol=1e-9)
    assert np.ptp(measured) > 0.1
    assert "Rank 1: error of measured places [m] against step" in titles(recorded.path)


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
    assert "Rank 1: standard normals against step" in titles(recorded.path)


def test_without_latents_nothing_is_said_of_them(learned):
    assert "Random at the start" not in texts(learned.path)[paths.WORST_SUMMARY]
    assert not any("normals" in title or "error of" in title for title in titles(learned.path))


def test_a_logical_scenario_is_filmed_with_its_own_start_and_in_grey_from_contact_on(tmp_path):
    pytest.importorskip("highway_env")
    preset = load_preset("braking")
    config = replace(
        preset, method="naive", naive_detection_probability=0.02, memory_s=0.0, rules=(),
        spec="always[0,30] (clearance - collided >= 0)",
        encounter=replace(preset.encounter, states=31), final_rollouts=20, plan=False,
        start=(StartChoice(name="gap", distribution="uniform(8, 9)"),
               StartChoice(name="brake_time", distribution="0.2")),
    )  # fmt: skip
    recorded = record(with_blind_pem(config), tmp_path, frames=True)
    pictures = [c for c in chunks(recorded.path) if c.entity_path == paths.FRAMES]
    rows = [c.to_record_batch()["EncodedImage:blob"] for c in pictures if not c.is_static]
    frames = [np.asarray(PIL.Image.open(BytesIO(bytes(one[0]))).convert("RGB"), dtype=np.int64)
              for row in rows for one in row.to_pylist()]  # fmt: skip
    assert len(frames) == 31
    ranked, (stage,) = recorded.result.least_robust[0], recorded.stages
    signals = {name: v[ranked.rollout] for name, v in stage.scored.rollouts.signals.items()}
    assert signals["collided"].any()
    colored = [np.ptp(frame, axis=-1).max() > 60 for frame in frames]
    assert colored == (signals["collided"] == 0.0).tolist()
    # the orange car starts as far ahead of the blue one as in the rollout: 7.2 pixels a metre
    orange = (frames[0][..., 0] > 150) & (frames[0][..., 2] < 90)
    blue = (frames[0][..., 2] > 130) & (frames[0][..., 0] < 90)
    gap_px = np.flatnonzero(orange.any(axis=0))[0] - np.flatnonzero(blue.any(axis=0))[-1]
    assert gap_px / 7.2 == pytest.approx(signals["gap_lead"][0], abs=0.6)
