"""The tracker against one written out track by track, and its filters against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

import pemviz
from pemviz import AlphaBeta, Kalman, Tracker
from pemviz.errors import ConfigError
from tests.simulators.reference import OneTrack

DT_S = 0.1


CASES = [
    Tracker(dt_s=DT_S, hits=2, window=3, coast_s=0.2, axes=1),
    Tracker(dt_s=DT_S, hits=3, window=5, axes=2, filter=AlphaBeta(alpha=0.5, beta=0.2)),
    Tracker(dt_s=DT_S, hits=1, window=4, coast_s=0.3, axes=1, filter=AlphaBeta()),
    Tracker(dt_s=DT_S, hits=2, window=2, coast_s=0.1, axes=2, filter=Kalman()),
    Tracker(dt_s=DT_S, hits=1, window=1, coast_s=0.7, axes=1, filter=Kalman(position_sd_m=2.0)),
]


@pytest.mark.parametrize("tracker", CASES)
def test_tracks_are_those_of_one_written_out(tracker):
    count, steps = 60, 40
    draws = np.random.default_rng(1)
    detected = draws.random((steps, count)) < np.linspace(0.1, 0.9, count)
    positions = draws.normal(size=(steps, count, tracker.axes)).cumsum(axis=0)
    state = tracker.start(count)
    known = [OneTrack(tracker) for _ in range(count)]
    confirmations = 0
    for hit, z in zip(detected, positions, strict=True):
        state = tracker.update(state, hit, np.where(hit[:, None], z, 1e9))
        state = tracker.state(tracker.memory(state))
        for row, track in enumerate(known):
            track.update(hit[row], z[row])
            assert state.confirmed[row] == track.confirmed
            if track.confirmed:
                np.testing.assert_allclose(state.position_m[row], track.x[0], atol=1e-9)
                np.testing.assert_allclose(state.speed_mps[row], track.x[1], atol=1e-9)
                if track.p is not None:
                    np.testing.assert_allclose(state.covariance[row], track.p, atol=1e-9)
        confirmations += state.confirmed.sum()
    assert 0.2 < confirmations / (count * steps) < 0.95


def test_equal_futures_are_equal_states():
    """Whichever hits confirmed or dropped a track, nothing of them stays in the state."""
    tracker = Tracker(dt_s=DT_S, hits=2, window=3, coast_s=0.1, axes=1, filter=Kalman())
    states = []
    for outcomes in ("", "0", "100", "1100", "010100", "10111000"):
        state = tracker.start(1)
        for outcome in outcomes:
            state = tracker.update(state, np.array([outcome == "1"]), np.array([3.0]))
        states.append({name: values[0] for name, values in tracker.memory(state).items()})
    assert all(state == states[0] for state in states)
    one = tracker.update(tracker.start(1), np.array([True]), np.array([3.0]))
    assert tracker.steps_since_hit(one) == [0]
    assert tracker.hits_seen(one) == [1]


def test_slots_and_given_states_are_left_alone():
    tracker = CASES[2]
    detected = np.random.default_rng(2).random((20, 5, 3)) < 0.5
    together = tracker.start(5, slots=3)
    alone = [tracker.start(5) for _ in range(3)]
    for hit in detected:
        before = tracker.memory(together)
        copies = {name: values.copy() for name, values in before.items()}
        together = tracker.update(together, hit, np.full((5, 3), 4.0))
        assert all((before[name] == values).all() for name, values in copies.items())
        alone = [tracker.update(a, hit[:, k], np.full(5, 4.0)) for k, a in enumerate(alone)]
        together = tracker.state(tracker.memory(together), slots=3)
    for slot, state in enumerate(alone):
        for one, other in zip(tracker.numbers(together), tracker.numbers(state), strict=True):
            np.testing.assert_array_equal(one[:, slot], other)


def test_kalman_settles_at_the_tracking_index_s_gains():
    """Kalata (1984): both gains in closed form of the index dt^2 sd(acceleration) / sd(z)."""
    kalman = Kalman(position_sd_m=0.4, acceleration_sd_mps2=6.0)
    index = DT_S**2 * kalman.acceleration_sd_mps2 / kalman.position_sd_m
    r = (4.0 + index - np.sqrt(8.0 * index + index**2)) / 4.0
    alpha = 1.0 - r**2
    beta = 2.0 * (2.0 - alpha) - 4.0 * np.sqrt(1.0 - alpha)
    state = settled(kalman, lambda step: 0.0)
    later = kalman.predicted(state.motion, dt_s=DT_S)
    step = kalman.corrected(later, np.ones((1, 1)) + later.position_m, dt_s=DT_S)
    assert step.position_m - later.position_m == pytest.approx(alpha, rel=1e-9)
    assert (step.speed_mps - later.speed_mps) * DT_S == pytest.approx(beta, rel=1e-9)
    measured = kalman.position_sd_m**2
    assert state.covariance[0, 0, 0] == pytest.approx(alpha * measured, rel=1e-9)
    assert state.covariance[0, 0, 1] == pytest.approx(beta * measured / DT_S, rel=1e-9)


def settled(track_filter, position_of, steps=400):
    tracker = Tracker(dt_s=DT_S, hits=1, window=1, axes=1, filter=track_filter)
    state = tracker.start(1)
    for step in range(steps):
        state = tracker.update(state, np.array([True]), np.array([position_of(step)]))
    return state


def test_alpha_beta_lags_behind_an_acceleration_as_it_must():
    """(1 - alpha) a dt^2 / beta in position, (2 alpha - beta) a dt / (2 beta) in speed."""
    alpha, beta, a_mps2 = 0.6, 0.3, 2.0
    state = settled(AlphaBeta(alpha=alpha, beta=beta), lambda k: 0.5 * a_mps2 * (k * DT_S) ** 2)
    time_s = 399 * DT_S
    lag_m = 0.5 * a_mps2 * time_s**2 - state.position_m[0, 0]
    assert lag_m == pytest.approx((1 - alpha) * a_mps2 * DT_S**2 / beta, rel=1e-6)
    lag_mps = a_mps2 * time_s - state.speed_mps[0, 0]
    assert lag_mps == pytest.approx((2 * alpha - beta) * a_mps2 * DT_S / (2 * beta), rel=1e-6)


def test_kalman_without_noise_is_the_line_of_least_squares():
    """Misses leave out points; what is known of the speed beforehand is one equation more."""
    kalman = Kalman(position_sd_m=0.3, acceleration_sd_mps2=0.0, first_speed_sd_mps=0.7)
    tracker = Tracker(dt_s=DT_S, hits=1, window=1, coast_s=1.0, axes=1, filter=kalman)
    draws = np.random.default_rng(3)
    hit, z = draws.random(30) < 0.6, draws.normal(size=30)
    hit[0] = True
    state = tracker.start(1)
    for detected, measured in zip(hit, z, strict=True):
        state = tracker.update(state, np.array([detected]), np.array([measured]))
    time_s = (np.flatnonzero(hit) - 29) * DT_S
    design = np.stack([np.ones_like(time_s), time_s], axis=1) / 0.3
    design = np.concatenate([design, [[0.0, 1.0 / 0.7]]])
    line = np.linalg.lstsq(design, np.append(z[hit] / 0.3, 0.0), rcond=None)[0]
    spread = np.linalg.inv(design.T @ design)
    np.testing.assert_allclose((state.position_m[0, 0], state.speed_mps[0, 0]), line, rtol=1e-9)
    np.testing.assert_allclose(state.covariance[0], spread, rtol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"hits": 4}, "4 of 3 hits: must be at least 1, and no more than the window"),
        ({"coast_s": -1.0}, "coast_s = -1.0: must be at least 0"),
        ({"dt_s": 0.0}, "dt_s = 0.0: must be above 0 and finite"),
        ({"axes": 3}, "axes = 3: must be 0, 1 or 2"),
        ({"filter": Kalman()}, "axes = 0: must be 1 or 2 with a filter"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(wrong, words):
    with pytest.raises(ConfigError, match=f"^tracker: {words}") as raised:
        replace(Tracker(dt_s=DT_S), **wrong)
    assert "\n" not in str(raised.value)


def test_filters_and_positions_out_of_range_are_refused():
    with pytest.raises(pemviz.ConfigError, match=r"alpha = 1\.5: must be a number, above 0 and at"):
        AlphaBeta(alpha=1.5)
    with pytest.raises(pemviz.ConfigError, match=r"beta = 3: must be below 2\.6"):
        AlphaBeta(alpha=0.7, beta=3.0)
    with pytest.raises(pemviz.ConfigError, match="position_sd_m = 0"):
        Kalman(position_sd_m=0.0)
    tracker = CASES[1]
    for positions in (None, np.zeros(2), np.zeros((2, 1))):
        with pytest.raises(ValueError, match=r"for 2 axes: must be of shape \(2, 2\)"):
            tracker.update(tracker.start(2), np.array([True, False]), positions)
