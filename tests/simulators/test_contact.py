"""Contact against motion worked out by hand."""

import numpy as np
import pytest

from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M, FollowedCar, first_contact

DT_S = 0.1
# closing at 5 m/s from 3.2 m: 3.2, 2.7, 2.2, 1.7, ... m
CLOSING_M = 3.2 - 0.5 * np.arange(8.0)


def test_the_first_state_whose_bumpers_touch_and_the_speed_that_closed_the_gap():
    contact = first_contact(CLOSING_M, dt_s=DT_S)
    assert contact is not None
    assert contact.step == 3
    assert contact.time_s == pytest.approx(0.3)
    assert contact.impact_speed_mps == pytest.approx(5.0)


def test_touching_exactly_is_contact_and_a_hair_more_is_not():
    gap_m = np.array([4.0, CAMERA_TO_BUMPER_M, 3.0])
    assert first_contact(gap_m, dt_s=DT_S).step == 1
    assert first_contact(np.nextafter(gap_m, np.inf), dt_s=DT_S) is None


def test_from_contact_on_nothing_that_is_drawn_moves():
    signals = {"gap": CLOSING_M, "ego_speed": np.full(8, 10.0), "lead_speed": np.full(8, 5.0)}
    scene = FollowedCar(DT_S, lead_length_m=4.0).scene(signals)
    ego_m, lead_m = scene.x_m.T
    np.testing.assert_allclose(ego_m, [0.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0])
    between_m = (lead_m - 2.0) - (ego_m + 2.5)
    np.testing.assert_allclose(between_m, [1.2, 0.7, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
    assert scene.collided.tolist() == [False] * 3 + [True] * 5
    assert scene.impact_speed_mps[3] == pytest.approx(5.0)


def test_who_never_touches_is_drawn_where_it_is():
    signals = {name: np.full(4, 10.0) for name in ("gap", "ego_speed", "lead_speed")}
    scene = FollowedCar(DT_S).scene(signals)
    assert not scene.collided.any()
    np.testing.assert_allclose(np.diff(scene.x_m, axis=1)[:, 0], 5.0 + 10.0 - CAMERA_TO_BUMPER_M)
    np.testing.assert_allclose(scene.x_m[:, 0], [0.0, 1.0, 2.0, 3.0])


def test_a_rollout_that_begins_in_contact_has_no_impact():
    contact = first_contact(np.array([1.0, 0.5]), dt_s=DT_S)
    assert (contact.step, contact.impact_speed_mps) == (0, 0.0)
