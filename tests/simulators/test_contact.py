"""Contact against motion worked out by hand."""

import numpy as np
import pytest

from pemviz.simulators.braking.contact import (
    CAMERA_TO_BUMPER_M,
    drawn_gap,
    first_contact,
    until_contact,
)

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


def test_from_contact_on_nothing_moves():
    contact = first_contact(CLOSING_M, dt_s=DT_S)
    travelled_m = np.arange(8.0)
    assert until_contact(travelled_m, contact).tolist() == [0.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0]
    drawn_m = drawn_gap(CLOSING_M, contact)
    np.testing.assert_array_equal(drawn_m[:3], CLOSING_M[:3])
    assert (drawn_m[3:] == CAMERA_TO_BUMPER_M).all()
    assert (drawn_m >= CAMERA_TO_BUMPER_M).all()


def test_who_never_touches_is_left_alone():
    gap_m = np.full(4, 10.0)
    assert until_contact(gap_m, None) is gap_m
    np.testing.assert_array_equal(drawn_gap(gap_m, None), gap_m)


def test_a_rollout_that_begins_in_contact_has_no_impact():
    contact = first_contact(np.array([1.0, 0.5]), dt_s=DT_S)
    assert (contact.step, contact.impact_speed_mps) == (0, 0.0)
