"""Rules of the encounters against CommonRoad's own monitor of them, on 200 random ones.

Its environment is made by
    python3.11 -m venv .venv-commonroad
    .venv-commonroad/bin/pip install -r tests/simulators/encounters/commonroad_requirements.txt
and is 1.7 GB; PEMVIZ_COMMONROAD_PYTHON may name another's Python, which then must be there.

Their R_G1 and R_G2 (Maierhofer et al. 2020) are given the trajectories alone. Where the published
text mixes metres of gap with m/s^2, or is bounded by how far a car is from leaving its lane, the
same rule is asked for the robustness of what it is about alone: its conditions (``_i``) are then
true or false (Ferrere et al. 2019), and so infinite. The lead car brakes in its lane: how long a
car that cut in may stay too near is not compared.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pemviz.config import EncounterConfig, StartChoice
from pemviz.simulators.encounters.vectorized import VectorizedEncounters

ROOT = Path(__file__).resolve().parents[3]
TRACES = 200
ABRUPT_MPS2 = 6.0
FRONT = "in_front_of(a0, a1)_i and in_same_lane(a0, a1)_i"
RULES = {
    "R_G1": "R_G1",
    "R_G2": "R_G2",
    "distance": f"A a1: (({FRONT}) implies keeps_safe_distance_prec(a0, a1))",
    "braking": (
        "brakes_abruptly(a0) implies E a1: ($precedes(a0, a1)_i and "
        "(not keeps_safe_distance_prec(a0, a1)_i or not brakes_abruptly_relative(a0, a1)))"
    ),
}
CONFIG = EncounterConfig(
    logical_scenario="braking",
    recovery_time_s=0.0,
    states=31,
    gap_bound_m=1e4,
    ghost_probability=0.1,
)
START = {
    "ego_speed": "uniform(5, 30)",
    "gap": "uniform(4, 60)",
    "closing_speed": "uniform(-4, 10)",
    "brake_time": "uniform(0, 2)",
    "deceleration": "uniform(0.5, 9)",
    "ghost_gap": "uniform(10, 60)",
}


@pytest.fixture(scope="module")
def commonroad_python():
    named = os.environ.get("PEMVIZ_COMMONROAD_PYTHON")
    path = named or str(ROOT / ".venv-commonroad/bin/python")
    if not Path(path).exists():
        if named:
            pytest.fail(f"PEMVIZ_COMMONROAD_PYTHON = {named}: there is no such file")
        pytest.skip(f"no environment with CommonRoad's monitor at {path}")
    return path


@pytest.fixture(scope="module")
def signals():
    """Signals ``[N, T]``; half of the rollouts see little of the lead car, all now and then a
    ghost, of which the monitor is not told: many break rules."""
    start = tuple(StartChoice(name, text) for name, text in START.items())
    logical_scenario, rng = VectorizedEncounters(CONFIG, start), np.random.default_rng(19)
    shown = np.where(np.arange(TRACES) % 2, 0.05, 0.8)[:, None]
    states = [
        logical_scenario.initial(
            count=TRACES, start=rng.standard_normal((TRACES, logical_scenario.latents.start))
        )
    ]
    for _ in range(CONFIG.states - 1):
        outcomes = rng.random((TRACES, 2)) < np.concatenate([shown, np.full_like(shown, 0.2)], 1)
        states.append(logical_scenario.step(states[-1], outcomes))
    return {
        name: np.stack([state.signals[name] for state in states], axis=1)
        for name in states[0].signals
    }


def trajectory(x_m, speed_mps):
    """Acceleration until the next state, as CommonRoad's files have it."""
    steps = np.diff(speed_mps) / CONFIG.dt_s
    acceleration = np.append(steps, steps[-1])
    return {"x": x_m.tolist(), "speed": speed_mps.tolist(), "acceleration": acceleration.tolist()}


@pytest.fixture(scope="module")
def answers(commonroad_python, signals):
    traces = []
    for row in range(TRACES):
        until = len_before_contact(signals, row)
        one = {name: values[row, :until] for name, values in signals.items()}
        ahead_m = one["gap_lead"] + CONFIG.car_length_m
        traces.append(
            {
                "ego": trajectory(one["ego_x"], one["ego_speed"]),
                "lead": trajectory(one["ego_x"] + ahead_m, one["speed_lead"]),
                # their R_G2 gives no answer unless there is a third car
                "behind": trajectory(one["ego_x"] - 40.0, one["ego_speed"]),
            }
        )
    request = {
        "rules": RULES, "traces": traces, "dt_s": CONFIG.dt_s, "abrupt_mps2": ABRUPT_MPS2,
        "deceleration_mps2": CONFIG.hard_deceleration_mps2, "reaction_s": CONFIG.reaction_time_s,
        "length_m": CONFIG.car_length_m, "width_m": CONFIG.car_width_m,
    }  # fmt: skip
    told = subprocess.run(
        [commonroad_python, Path(__file__).with_name("commonroad_process.py")],
        input=json.dumps(request), capture_output=True, text=True, check=False, timeout=900,
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    return json.loads(told.stdout.splitlines()[-1])


def len_before_contact(signals, row):
    """States before contact, after which our signals stay what they are."""
    return int(np.argmax(np.append(signals["collided"][row] > 0.0, True)))


def compared(signals, answers, rule, ours):
    """Theirs and ours at all states of all rollouts but the last, which they leave out."""
    pairs = [
        (theirs[rule], ours[row, : len_before_contact(signals, row) - 1])
        for row, theirs in enumerate(answers)
    ]
    return (np.concatenate(side) for side in zip(*pairs, strict=True))


@pytest.mark.slow
def test_the_safe_distance_is_that_of_r_g1(signals, answers):
    ours = signals["safe_distance"]
    theirs, ours = compared(signals, answers, "distance", ours)
    # a lead car so fast that no distance is needed: theirs needs less than none
    needed = (signals["ego_speed"] ** 2 - signals["speed_lead"] ** 2) / (
        2 * CONFIG.hard_deceleration_mps2
    ) + CONFIG.reaction_time_s * signals["ego_speed"]
    _, needed = compared(signals, answers, "distance", needed)
    np.testing.assert_allclose(theirs - ours, np.clip(-needed, 0.0, None), rtol=0, atol=1e-6)
    assert 500 < np.count_nonzero(ours < 0.0) < ours.size - 500
    verdict, ours = compared(signals, answers, "R_G1", signals["safe_distance"])
    clear = np.abs(ours) > 1e-6
    np.testing.assert_array_equal(verdict[clear] < 0.0, ours[clear] < 0.0)


@pytest.mark.slow
def test_needless_braking_is_that_of_r_g2(signals, answers):
    margin = ABRUPT_MPS2 - signals["needless_deceleration"][:, 1:]  # of the step that led there
    theirs, ours = compared(signals, answers, "braking", margin)
    _, moves = compared(signals, answers, "braking", signals["speed_lead"][:, 1:] > 0.0)
    np.testing.assert_allclose(np.minimum(theirs, ABRUPT_MPS2), ours, rtol=0, atol=1e-6)
    assert np.count_nonzero(ours < 0.0) > 100
    assert np.count_nonzero(~moves) > 100
    verdict, _ = compared(signals, answers, "R_G2", margin)
    clear = np.abs(ours) > 1e-6
    np.testing.assert_array_equal(verdict[clear] < 0.0, ours[clear] < 0.0)
