import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.config.tracker_text import read_tracker, tracker_grid
from pemviz.errors import ConfigError
from pemviz.simulators.tracking.tracker import Tracker


def test_a_grid_is_every_combination_that_can_be():
    found = [read_tracker(one) for one in tracker_grid("hits=1:3,window=2:4:2,coast=0:1:0.25")]
    expected = {
        (hits, 2 if hits == 1 else window, coast)
        for hits, window, coast in itertools.product((1, 2, 3), (2, 4), (0, 0.25, 0.5, 0.75, 1))
        if hits <= window
    }
    assert len(found) == len(expected)
    assert {(one.hits, one.window, one.coast) for one in found} == expected


def test_what_is_no_range_stays_as_it_is():
    text = "hits=2,window=3,coast=0.1:0.3:0.1,filter=alpha-beta,alpha=0.6:0.8:0.2"
    assert tracker_grid(text) == tuple(
        f"2/3,coast={coast},filter=alpha-beta,alpha={alpha}"
        for coast in ("0.1", "0.2", "0.3")
        for alpha in ("0.6", "0.8")
    )


@given(st.integers(2, 8), st.integers(0, 5), st.integers(0, 2**32 - 1))
def test_one_hit_confirms_whatever_the_window_is(window, coast_steps, seed):
    detected = np.random.default_rng(seed).random((40, 1)) < 0.5

    def confirmed(window):
        tracker = Tracker(dt_s=0.1, hits=1, window=window, coast_s=0.1 * coast_steps)
        state, found = tracker.start(1), []
        for outcome in detected:
            state = tracker.update(state, outcome)
            found.append(bool(state.confirmed[0]))
        return found

    assert confirmed(window) == confirmed(1)


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("hits=1:3", ["window is missing"]),
        ("hits=3:1,window=3", ["'3:1'", "rising"]),
        ("hits=1:3,window=3,coast=0:1:0", ["'0:1:0'"]),
        ("hits=1:3,window=3,coast=0:1:0.1:2", ["'0:1:0.1:2'"]),
        ("hits=1:3,window=3,coast=a:b", ["'a:b'"]),
        ("hits=1:1e9,window=3", ["at most 1000 values"]),
        ("hits=1:nan,window=3", ["'1:nan'"]),
        ("hits=4:5,window=3", ["more hits than outcomes"]),
        ("hits=1:2:0.5,window=3", ["M/N"]),
        ("hits=1,window=3,hits=2", ["once"]),
        ("hits=1,window=3,trust=3", ["trust=3"]),
        ("hits=1,window=60", ["window", "at most 30"]),
    ],
)
def test_grids_that_cannot_be_are_one_line(text, fragments):
    with pytest.raises(ConfigError) as refused:
        tracker_grid(text)
    assert "\n" not in str(refused.value)
    for fragment in fragments:
        assert fragment in str(refused.value)
