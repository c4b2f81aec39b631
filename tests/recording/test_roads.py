"""A scenario that tells where its cars are has its least robust rollouts drawn on their roads."""

import numpy as np
import pytest

import pemviz
from pemviz.colors import DETECTED, GREY, MISSED, rgba
from pemviz.recording import paths
from pemviz.recording.outcomes import outcome_frame
from pemviz.recording.scene_layout import road_place
from pemviz.recording.scene_plan import row_m
from pemviz.runs.drawn_rollout import NOT_ASKED, RIGHT, WRONG, drawn_rollout, remembered
from tests.recording import read_back
from tests.recording.conftest import record, strips, texts, values_at
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


def columns(recorded, entity):
    """Every column logged along an entity, by name."""
    return {
        name: column
        for chunk in read_back.chunks(recorded.path)
        if chunk.entity_path == entity and not chunk.is_static
        for batch in [chunk.to_record_batch()]
        for name, column in zip(batch.schema.names, batch.columns, strict=True)
    }


def values(recorded, entity, name):
    return columns(recorded, entity)[name].to_pylist()


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
    for path, name in ((paths.lane(1, "words"), "Points3D"), (paths.plan(1, "words"), "Points2D")):
        labels = [row[0] for row in values(recorded, path, f"{name}:labels")]
        assert [words in label for label in labels] == [step >= contact for step in range(41)]


def test_marks_and_words_tell_what_perception_told_of_each_car(recorded, rollout):
    contact = first_contact(rollout)
    labels = values(recorded, paths.plan(1, "words"), "Points2D:labels")
    lines = values(recorded, paths.plan(1, "outcomes"), "LineStrips2D:colors")
    present = CutIn().present(rollout.signals)[0]
    assert not present[:contact].all()
    for step in range(contact):
        seen, there = rollout.detected[0, step], present[step]
        expected = [
            "not in view" if not there[slot] else "detected" if seen[slot] else "MISSED"
            for slot in range(2)
        ]
        assert [label.split(": ")[1] for label in labels[step][1:]] == expected
        shades = [rgba(MISSED)] * 3 * expected.count("MISSED")
        shades += [rgba(DETECTED)] * expected.count("detected")
        numbers = sorted(r << 24 | g << 16 | b << 8 | a for r, g, b, a in shades)
        assert sorted(lines[step]) == numbers


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
    flat = values(recorded, paths.plan(1, "tracks"), "LineStrips2D:strips")
    assert [len(row) for row in flat] == (2 * shown.sum(axis=1)).tolist()


def test_roads_do_not_overlap_and_the_page_says_what_is_drawn(recorded, rollout):
    drawn = drawn_rollout(
        CutIn(),
        signals={name: v[0] for name, v in rollout.signals.items()},
        detected=rollout.detected[0],
        memory={},
    )
    assert drawn.tracks is None
    near, far = road_place(drawn, 1), road_place(drawn, 2)
    assert near.high_m + near.shift_m < far.low_m + far.shift_m
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
    assert drawn.answers.tolist() == [[RIGHT, NOT_ASKED], [WRONG, WRONG]]


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
