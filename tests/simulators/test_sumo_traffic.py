"""Traffic in SUMO: whose randomness it is, who has a slot, what is told, what is refused."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pemviz.cli.record_arguments import parse
from pemviz.config import ExperimentConfig
from pemviz.config.settings import SumoConfig
from pemviz.config.toml_files import config_from_table, config_table, load_preset, with_own_rules
from pemviz.errors import ConfigError, RunError
from pemviz.files.shipped import asset_path
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.episodic import SideBySide
from pemviz.simulators.sumo.traffic.messages import NOBODY_M, SLOTS, TrafficSettings
from pemviz.simulators.sumo.traffic.places import Body, kept_places, leader_of, perceived, seen_from
from pemviz.simulators.sumo.traffic.simulator import (
    TrafficEpisodes,
    build_traffic,
    slot_signals,
    traffic_file,
)

SHORT = SumoConfig(config="free-traffic", states=41)
TRACKER = replace(ExperimentConfig().scenario, tracker="2/3,filter=kalman")


@pytest.fixture(scope="module")
def simulator():
    return build_traffic(SHORT, TRACKER)


@pytest.fixture(scope="module")
def drawn(simulator):
    """Six rollouts of three seeds, the first three blind to everything."""
    start = np.random.default_rng(0).standard_normal((6, 1))
    start[3:] = start[:3]
    detected = np.ones((6, 40, len(SLOTS)), dtype=np.bool_)
    detected[:3] = False
    return start, detected, replay(simulator=simulator, detected=detected, start=start)


def test_a_rollout_is_its_seed_s_whatever_is_beside_it(simulator, drawn):
    start, detected, together = drawn
    alone = replay(simulator=simulator, detected=detected[3:5], start=start[3:5])
    for name, values in alone.items():
        np.testing.assert_array_equal(values, together[name][3:5])
    one_by_one = replace(simulator, scenario=SideBySide(make=simulator.scenario.make))
    again = replay(simulator=one_by_one, detected=detected[1:2], start=start[1:2])
    for name, values in again.items():
        np.testing.assert_array_equal(values, together[name][1:2])


def test_seeds_differ_and_outcomes_matter(drawn):
    _, _, signals = drawn
    assert len(np.unique(signals["ego_speed"][:, 0])) == 3
    for name, values in signals.items():  # blind and seeing: the same traffic to begin with
        np.testing.assert_array_equal(values[:3, 0], values[3:, 0], err_msg=name)
    assert np.abs(signals["ego_speed"][:3] - signals["ego_speed"][3:]).max() > 0.1


def test_signals_hang_together(simulator, drawn):
    _, _, signals = drawn
    driven_m = np.diff(signals["distance"], axis=1)
    mean_mps = (signals["ego_speed"][:, :-1] + signals["ego_speed"][:, 1:]) / 2
    over = signals["collided"][:, 1:] > 0.0
    np.testing.assert_allclose(driven_m[~over], 0.1 * mean_mps[~over], atol=1e-9)
    gained_mps = np.diff(signals["ego_speed"], axis=1)
    got = signals["ego_acceleration"][:, 1:]
    np.testing.assert_allclose(got[~over], gained_mps[~over] / 0.1, atol=1e-9)
    gap_m, aside_m, _, _ = slot_signals(signals)
    there = simulator.present(signals)
    assert (gap_m[there] > 0.0).all()
    assert (gap_m[there] < 100.0).all()
    beside = there & (np.abs(aside_m) < 1.0)
    least_m = np.where(beside, gap_m, np.inf).min(axis=-1)
    free = signals["collided"] == 0.0
    assert (signals["clearance"][free] <= least_m[free] + 1e-9).all()
    assert there.mean() > 0.8


def body(x_m, y_m, *, angle_deg=90.0):
    return Body((x_m, y_m), angle_deg, 20.0, 4.5, 1.8)


def test_cars_are_seen_along_the_ego_whichever_way_it_heads():
    for angle_deg in (0.0, 90.0, 200.0):
        along = np.radians(90.0 - angle_deg)
        ego = body(7.0, -3.0, angle_deg=angle_deg)
        x_m = 7.0 + 30.0 * np.cos(along) - 2.0 * np.sin(along)
        y_m = -3.0 + 30.0 * np.sin(along) + 2.0 * np.cos(along)
        car = seen_from(ego, body(x_m, y_m, angle_deg=angle_deg))
        got = (car.gap_m, car.aside_m, car.speed_mps, car.heading_rad, car.apart_m)
        assert got == pytest.approx((25.5, 2.0, 20.0, 0.0, 25.5))
    across = seen_from(body(0.0, 0.0), body(20.0, 5.0, angle_deg=180.0))  # heads to the right
    assert (across.gap_m, across.aside_m) == pytest.approx((19.1, 7.25))
    assert (across.speed_mps, across.heading_rad) == pytest.approx((0.0, -np.pi / 2))
    assert seen_from(body(0.0, 0.0), body(4.0, 1.0)).apart_m == pytest.approx(-0.5)


def test_slots_have_the_car_in_the_path_and_the_nearest_others():
    places = {
        "far": (60, 0),
        "right": (20, -3.5),
        "left": (15, 3.5),
        "next": (40, 3.5),
        "by": (1, 3.5),
    }
    cars = {name: seen_from(body(0.0, 0.0), body(*at)) for name, at in places.items()}
    assert leader_of(cars) == "far"
    assert perceived(cars, [None] * 3) == ["far", "left", "right"]
    # who comes in front takes a slot a step after the one that it was is empty
    cars["cuts"] = seen_from(body(0.0, 0.0), body(30, 0.5))
    after = perceived(cars, ["far", "left", "right"])
    assert after == [None, "left", "right"]
    assert perceived(cars, after) == ["cuts", "left", "right"]


def test_places_are_kept():
    assert kept_places(["a", "c"], ["b", "a"]) == [None, "a"]
    assert kept_places(["a", "c"], [None, "a"]) == ["c", "a"]


def test_a_track_does_not_outlive_its_car(simulator):
    states = simulator.initial(count=1, start=np.zeros((1, 1)))
    seen = np.ones((1, len(SLOTS)), dtype=np.bool_)
    states = simulator.step(states, seen)
    tracks = simulator.tracker.state(states.memory, slots=len(SLOTS))
    assert tracks.window[0, :2].tolist() == [1, 1]
    gone = {**states.signals, "gap_second": np.array([NOBODY_M])}
    after = simulator.step(replace(states, signals=gone), ~seen)
    tracks = simulator.tracker.state(after.memory, slots=len(SLOTS))
    assert tracks.window[0, :2].tolist() == [0b10, 0]


def test_nothing_that_sumo_draws_has_a_weight(simulator):
    config = replace(
        load_preset("free-traffic"), method="mixture", sumo=replace(SHORT, states=11),
        rollouts=4, final_rollouts=4, stages=1,
    ).with_rules({"slow": "always[0,10] (ego_speed <= 27.0)"})  # fmt: skip
    experiment = build_experiment(config)
    state = experiment.method.init(experiment.problem, repetition=0)
    while not experiment.method.is_done(state):
        state, stage = experiment.method.step(experiment.problem, state)
        latents = stage.scored.rollouts.latents
        assert latents.start.shape[1] == 1
        assert not latents.start_mean.any()
        assert not latents.log_weight.any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hello", "invalid document structure"),
        ("", "invalid document structure"),
        ('<configuration><nett value="x"/></configuration>', "No option with the name 'nett'"),
        ('<configuration><net-file value="gone.net.xml"/></configuration>', "not accessible"),
    ],
)
def test_a_broken_sumocfg_is_one_line(tmp_path, text, words):
    path = tmp_path / "broken.sumocfg"
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        build_traffic(SumoConfig(config=str(path)), TRACKER)
    assert words in str(refused.value)
    assert str(refused.value).startswith(f"sumo.config {path}: SUMO: ")
    assert "\n" not in str(refused.value)


def test_what_traffic_cannot_be_is_told_in_one_line():
    with pytest.raises(ConfigError, match=r"no vehicle 'nobody' enters"):
        build_traffic(replace(SHORT, ego="nobody"), TRACKER)
    with pytest.raises(ConfigError, match=r"the ego 'ego' leaves before"):
        build_traffic(replace(SHORT, warm_up_s=250.0), TRACKER)
    with pytest.raises(ConfigError, match=r"must be free-traffic or a \.sumocfg file"):
        traffic_file(SumoConfig(config="gone.sumocfg"))
    traffic = replace(load_preset("free-traffic"), encounters_per_hour=3.0)
    with pytest.raises(ConfigError, match="answered per kilometre"):
        traffic.validate()
    with pytest.raises(ConfigError, match=r"sumo\.step_s = 0\.0125: must be whole"):
        replace(load_preset("free-traffic"), sumo=replace(SHORT, step_s=0.0125)).validate()
    with pytest.raises(ConfigError, match=r"needs|episodic"):
        build_experiment(replace(load_preset("free-traffic"), method="splitting"))


def test_a_process_that_dies_is_told_in_one_line():
    path = str(asset_path("sumo", "free-traffic.sumocfg"))
    settings = TrafficSettings(path, "ego", warm_up_s=1.0, step_s=0.1)
    episode = TrafficEpisodes(settings, states=5)
    episode.reset(np.zeros(1))
    episode._pipe._end.shutdown(2)
    with pytest.raises(RunError, match="its process ended without a word"):
        episode.step(0.0)
    assert set(episode.reset(np.zeros(1))) == {signal.name for signal in episode.signals}


def test_options_and_files_name_the_traffic():
    asked = parse(
        ["--simulator", "sumo", "--sumo-config", "a.sumocfg", "--sumo.ego", "me"]
    ).experiment
    assert asked.sumo == SumoConfig(config="a.sumocfg", ego="me")
    assert asked.rules == load_preset("free-traffic").rules
    assert with_own_rules(replace(asked, rules=(), spec="always[0,9] (clearance >= 1)")).rules == ()
    assert config_from_table(config_table(asked)) == asked
    assert not asked.is_braking_scenario
    assert partial(replace, asked)(sumo=SumoConfig()).is_braking_scenario
