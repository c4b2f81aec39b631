"""Encounters against one written out in plain numbers, and against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit

from pemviz.config import LOGICAL_SCENARIOS, EncounterConfig, StartChoice
from pemviz.pem import load_pem
from pemviz.pem.models.position_errors import NoiseMemory, constant_errors
from pemviz.sampling.slots import with_slots
from pemviz.simulators.encounters.scenario import EncounterFeatures
from pemviz.simulators.encounters.sight import displaced
from pemviz.simulators.encounters.vectorized import VectorizedEncounters
from pemviz.simulators.slots import UnrolledSimulator
from pemviz.types import StateBatch
from tests.simulators.encounters.reference import Encounter

TRACKERS = ("none", "2/3,coast=0.2", "1/2,coast=0.3,filter=alpha-beta", "2/3,filter=kalman")


def chosen(**values):
    return tuple(StartChoice(name, str(value)) for name, value in values.items())


def rolled_out(simulator, start, detected):
    """All states for latents ``[N, S]`` and outcomes ``[T-1, N, K]``."""
    states = [simulator.initial(count=len(start), start=start)]
    for outcome in detected:
        states.append(simulator.step(states[-1], outcome))
    return states


def latents(simulator, count, seed=0):
    return np.random.default_rng(seed).standard_normal((count, simulator.latents.start))


def outcomes(simulator, count, share, seed=1):
    size = (simulator.states - 1, count, len(simulator.slots))
    return np.random.default_rng(seed).random(size) < share


@pytest.mark.parametrize(
    ("logical_scenario", "tracker"),
    [("braking", TRACKERS[1]), *(("cut-in", tracker) for tracker in TRACKERS),
     ("cut-out", TRACKERS[0]), ("cut-out", TRACKERS[2])],
)  # fmt: skip
def test_encounters_are_those_of_one_written_out(logical_scenario, tracker):
    """Each row with its own share of hits, starts far beyond the default ones."""
    config = EncounterConfig(
        logical_scenario=logical_scenario, neighbour=tracker != "none",
        side="left" if "kal" in tracker else "right",
        states=36, dt_s=0.2, camera_half_angle_deg=25.0, farthest_m=60.0, path_half_width_m=2.0,
        ghost_probability=0.1 if "2/3" in tracker else 0.0,
    )  # fmt: skip
    wide = chosen(gap="uniform(3, 60)", closing_speed="uniform(-3, 15)")
    if config.ghost_probability:
        wide += chosen(ghost_gap="uniform(0, 60)")
    simulator = VectorizedEncounters(config, wide, tracker)
    start, count = latents(simulator, 12), 12
    detected = outcomes(simulator, count, np.linspace(0.0, 1.0, count)[:, None])
    states = rolled_out(simulator, start, detected)
    values = simulator.start_values(start)
    for row in range(count):
        own = {name: float(value[row]) for name, value in values.items()}
        one = Encounter(config, own, simulator.tracker)
        for time, state in enumerate(states):
            expected = {
                "ego_x": one.x, "ego_speed": one.speed, "ego_acceleration": one.acceleration,
                "clearance": one.clearance(), "safe_distance": one.safe,
                "needless_deceleration": one.needless, "collided": float(one.collided),
                "impact_speed": one.impact if one.collided else 0.0,
            }  # fmt: skip
            if logical_scenario == "cut-in":
                expected["avoidable_by"] = one.avoidable
            for name, car in zip(simulator.reported_names, one.reported, strict=True):
                of_car = (one.gap(car), car.y, car.speed, car.heading)
                what = ("gap", "aside", "speed", "heading")
                expected |= {f"{w}_{name}": v for w, v in zip(what, of_car, strict=True)}
            assert set(expected) == {signal.name for signal in simulator.signals}
            found = {name: float(values[row]) for name, values in state.signals.items()}
            assert found == pytest.approx(expected, abs=1e-9), (row, time)
            present, salient = zip(*one.seen(), strict=True)
            assert tuple(simulator.present(state.signals)[row]) == present, (row, time)
            np.testing.assert_allclose(simulator.salient(state.signals)[row], salient, atol=1e-9)
            if time < len(detected):
                one.step(detected[time, row])
    collided = states[-1].signals["collided"]
    assert 0.0 < collided.mean() < 1.0


def test_an_ego_that_sees_nothing_hits_a_braking_car_when_and_as_fast_as_sums_say():
    """Braking at a from step m on, at speed v both, gap g: closed by a dt^2 n (n - 1) / 2."""
    fixed = chosen(ego_speed=20, gap=30, closing_speed=0, brake_time=1, deceleration=4)
    simulator = VectorizedEncounters(EncounterConfig(logical_scenario="braking"), fixed)
    assert simulator.latents.start == 0
    states = rolled_out(simulator, np.zeros((1, 0)), np.zeros((90, 1, 1), dtype=bool))
    closed_m = [4.0 * 0.01 * n * (n - 1) / 2 for n in range(60)]
    steps = next(n for n, closed in enumerate(closed_m) if closed >= 30.0)
    contact = 10 + steps
    assert [float(s.signals["collided"][0]) for s in states[contact - 1 : contact + 1]] == [0, 1]
    assert float(states[contact].signals["impact_speed"][0]) == pytest.approx(0.4 * (steps - 1))
    share = (30.0 - closed_m[steps - 1]) / (closed_m[steps] - closed_m[steps - 1])
    x_m = float(states[contact].signals["ego_x"][0])
    assert x_m == pytest.approx(20.0 * 0.1 * (contact - 1 + share))
    for state in states[contact:]:
        moving = {n: float(v[0]) for n, v in state.signals.items() if "speed" in n}
        assert moving == {"ego_speed": 0, "speed_lead": 0, "impact_speed": moving["impact_speed"]}
        assert float(state.signals["ego_x"][0]) == x_m
        assert float(state.signals["gap_lead"][0]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("logical_scenario", LOGICAL_SCENARIOS)
def test_an_ego_that_misses_nothing_hits_nothing_and_brakes_with_reason(logical_scenario):
    """Of 2,000 starts none: with every one in 500 it would be found out with 98 %."""
    simulator = VectorizedEncounters(EncounterConfig(logical_scenario=logical_scenario))
    every = np.ones((simulator.states - 1, 2000, len(simulator.slots)), dtype=bool)
    state = simulator.initial(count=2000, start=latents(simulator, 2000))
    for outcome in every:
        state = simulator.step(state, outcome)
        assert state.signals["clearance"].min() > 0.0
        assert state.signals["needless_deceleration"].max() <= 6.0


def test_both_sides_are_alike():
    right = VectorizedEncounters(EncounterConfig(logical_scenario="cut-in", neighbour=True))
    left = replace(right, config=replace(right.config, side="left"))
    start, detected = latents(right, 20), outcomes(right, 20, 0.4)
    states = zip(rolled_out(right, start, detected), rolled_out(left, start, detected), strict=True)
    for one, other in states:
        for name, values in one.signals.items():
            sign = -1.0 if name.startswith(("aside", "heading")) else 1.0
            np.testing.assert_allclose(values, sign * other.signals[name], atol=1e-12)


@pytest.mark.parametrize("tracker", TRACKERS[:2])
@pytest.mark.parametrize("logical_scenario", LOGICAL_SCENARIOS)
def test_what_does_not_matter_changes_nothing(logical_scenario, tracker):
    """Outcomes turned over where the scenario does not react: the same rollouts."""
    config = EncounterConfig(
        logical_scenario=logical_scenario, neighbour=True, ghost_probability=0.1
    )
    simulator = VectorizedEncounters(config, (), tracker)
    start, detected = latents(simulator, 200), outcomes(simulator, 200, 0.6)
    one = other = simulator.initial(count=200, start=start)
    turned = 0.0
    for outcome in detected:
        matters = simulator.reacts(one.signals) & simulator.present(one.signals)
        turned += (~matters).mean() / len(detected)
        one = simulator.step(one, outcome)
        other = simulator.step(other, np.where(matters, outcome, ~outcome))
        for name, values in one.signals.items():
            np.testing.assert_array_equal(values, other.signals[name])
    assert 0.1 < turned < 1.0


def test_a_revealed_car_is_hidden_until_the_lead_car_leaves():
    simulator = VectorizedEncounters(EncounterConfig(logical_scenario="cut-out"))
    states = rolled_out(simulator, np.zeros((1, 7)), np.ones((90, 1, 2), dtype=bool))
    present = np.array([simulator.present(state.signals)[0] for state in states])
    occlusion = np.array([simulator.salient(state.signals)[0, 1, 2] for state in states])
    aside_m = np.array([abs(state.signals["aside_lead"][0]) for state in states])
    seen = present[:, 1]
    assert not seen[:10].any()
    assert seen[-1]
    assert aside_m[seen].min() > 0.1
    assert set(occlusion[seen]) == {0.0, 1.0, 2.0}
    assert np.all(np.diff(occlusion[seen]) <= 0.0)


def test_a_ghost_that_is_reported_brakes_the_ego_without_reason():
    """At 30 m/s hard, and with nothing else ahead within its safe distance, until it is passed."""
    fixed = chosen(ego_speed=30, gap=140, closing_speed=0, deceleration=0, ghost_gap=50)
    config = EncounterConfig(logical_scenario="braking", ghost_probability=0.01, farthest_m=100.0)
    simulator = VectorizedEncounters(config, fixed)
    silent = np.tile(np.array([True, False]), (90, 1, 1))
    at_once = silent.copy()
    at_once[0, 0, 1] = True
    quiet, braked = (rolled_out(simulator, np.zeros((1, 1)), one) for one in (silent, at_once))
    assert float(braked[1].signals["needless_deceleration"][0]) == 8.0
    assert float(braked[1].signals["ego_speed"][0]) == pytest.approx(30.0 - 0.8)
    worst = max(float(state.signals["needless_deceleration"][0]) for state in quiet)
    assert worst == 0.0
    present = [bool(simulator.present(state.signals)[0, 1]) for state in quiet]
    # the place is in view while its centre is over 0.5 m ahead of the camera, 2 m behind the bumper
    assert present == [50.0 - 3.0 * t + 2.0 + 2.25 > 0.5 for t in range(91)]


def test_a_ghost_is_answered_for_by_the_probability_that_was_chosen():
    config = EncounterConfig(logical_scenario="cut-in", ghost_probability=0.02)
    unrolled = UnrolledSimulator(VectorizedEncounters(config))
    model, _ = with_slots(unrolled, load_pem("ml-nn"), None)
    salient = np.zeros((1, 13))
    salient[:, -2:] = 1.0, 2.0  # present, the third slot
    assert expit(-model.logit(salient)) == pytest.approx([0.02])
    assert model.name == "ml-nn+false positives 0.02"
    assert len(model.digest) == 64


def test_measured_places_are_off_along_and_across_the_line_of_sight():
    """As turning (along, across) by the bearing, in complex numbers: x to the right, z ahead."""
    config, rng = EncounterConfig(logical_scenario="braking"), np.random.default_rng(4)
    gap_m, aside_m = rng.uniform(1.0, 60.0, 50), rng.uniform(-5.0, 5.0, 50)
    along_m, across_m = rng.uniform(-2.0, 2.0, (2, 50))
    found = displaced(config, gap_m, aside_m, np.stack([along_m, across_m], axis=-1))
    true = gap_m + 2.0 + 2.25 - 1j * aside_m
    off = true + (along_m + 1j * across_m) * true / np.abs(true)
    np.testing.assert_allclose(found[0] + 2.0 + 2.25 - 1j * found[1], off, rtol=1e-12)


@pytest.mark.parametrize("tracker", ["none", "1/1"])
def test_the_ego_keeps_its_gap_to_where_a_car_is_measured(tracker):
    """A lead car straight ahead, a gap whose error lasts: follow by the formula with that gap."""
    errors = constant_errors(range_sd_m=2.0, memory=NoiseMemory(lasting_share=1.0))
    fixed = chosen(ego_speed=20, gap=35, closing_speed=2, deceleration=0)
    config = EncounterConfig(logical_scenario="braking", states=5)
    simulator = VectorizedEncounters(config, fixed, tracker, errors)
    assert (simulator.latents.start, simulator.latents.noise) == (1 + 2, 2)
    start = np.array([[0.0, -1.5, 0.7], [0.0, 0.0, 0.0]])  # brake_time, along, across
    states = simulator.initial(count=2, start=start)
    noise = np.random.default_rng(0).standard_normal((2, 2))  # nothing is forgotten: no influence
    for _ in range(4):
        gap_m = states.signals["gap_lead"] + np.array([-3.0, 0.0])
        ego_mps = states.signals["ego_speed"]
        closing_mps = ego_mps - states.signals["speed_lead"]
        wanted = 0.2 * (gap_m - 2.0 - 1.5 * ego_mps) - 0.8 * closing_mps
        states = simulator.step(states, np.ones((2, 1), dtype=bool), noise)
        expected = np.minimum(wanted.clip(-5.0, 2.0), 0.5 * (20.0 - ego_mps))
        np.testing.assert_allclose(states.signals["ego_acceleration"], expected, atol=1e-12)


def test_noise_of_slots_is_their_own_and_hangs_together_over_time():
    """Of 20,000 rollouts: standard errors of correlations are below 0.0071, 4.5 of them allowed."""
    memory = NoiseMemory(lasting_share=0.4, tau_s=0.3)
    plane = constant_errors(range_sd_m=1.0, cross_range_sd_m=1.0, memory=memory)
    config = EncounterConfig(logical_scenario="cut-in", dt_s=0.1)
    scenario = VectorizedEncounters(config, errors=plane)
    rng, count = np.random.default_rng(5), 20_000
    kept = scenario.noise.begin(count, rng.standard_normal((count, 4)))
    salient, errors = np.zeros((count, 2, 11)), []
    salient[..., 9] = 20.0
    for step in range(4):
        states = StateBatch(np.asarray(step), {"one": np.zeros(count)}, kept)
        kept = scenario.noise.renewed(states, rng.standard_normal((count, 4)))
        errors.append(scenario.errors_m(salient, kept).reshape(count, 4))
    found = np.corrcoef(np.concatenate(errors, axis=1).T).reshape(4, 4, 4, 4)
    for since in range(4):
        own = 0.4 + 0.6 * np.exp(-since * 0.1 / 0.3)
        np.testing.assert_allclose(found[0, :, since], own * np.eye(4), atol=0.032)


def test_slots_take_turns_and_features_are_the_slots_own():
    simulator = VectorizedEncounters(EncounterConfig(logical_scenario="cut-in"), (), "2/3")
    unrolled = UnrolledSimulator(simulator)
    features = EncounterFeatures(unrolled, simulator)
    states = unrolled.initial(count=3, start=latents(simulator, 3))
    first = features.values(states)
    second = features.values(unrolled.step(states, np.ones(3, dtype=bool)))
    np.testing.assert_array_equal(first[:, 0], states.signals["gap_cutting_in"].clip(max=80.0))
    np.testing.assert_array_equal(second[:, 0], states.signals["gap_lead"].clip(max=80.0))
    assert first.shape == (3, 7)


def test_start_values_are_what_cars_can_have_and_as_many_latents_as_are_random():
    wild = chosen(ego_speed="normal(0, 1)", duration=-1, gap="empirical(20, 30)")
    simulator = VectorizedEncounters(EncounterConfig(logical_scenario="cut-out"), wild)
    assert simulator.latents.start == len(simulator.starts) - 1
    values = simulator.start_values(latents(simulator, 50))
    assert set(values) == {signal.name for signal in simulator.starts}
    assert values["ego_speed"].min() == 0.0
    assert np.all(values["duration"] == simulator.dt_s)
    states = rolled_out(simulator, latents(simulator, 50), outcomes(simulator, 50, 0.5))
    for state in states:
        assert all(np.isfinite(values).all() for values in state.signals.values())


def test_features_foresee_that_a_car_comes_into_the_path():
    """Of a car that cuts in, within the steps before it matters; of what lies beyond, nothing."""
    fixed = chosen(gap=20, closing_speed=5, cut_in_time=1, duration=4, lead_gap=100, ego_speed=30)
    unrolled = UnrolledSimulator(
        VectorizedEncounters(EncounterConfig(logical_scenario="cut-in"), fixed)
    )
    features = EncounterFeatures(unrolled, unrolled.scenario)
    states, matters, foreseen = unrolled.initial(count=1), [], []
    for _ in range(unrolled.states - 1):
        if int(states.step) % 2 == 0:  # the turn of the car that cuts in
            matters.append(bool(features.reacts(states)[0]))
            foreseen.append(bool(features.reacts_within(states, steps=6)[0]))
        states = unrolled.step(states, np.zeros(1, dtype=bool))
    first = matters.index(True)
    assert 20 < first < 35
    assert not any(foreseen[: first - 12])
    assert all(foreseen[first - 5 : first + 1])
