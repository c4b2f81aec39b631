"""The families' compiled loops give what numpy gives, to the last bit."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz import compiling
from pemviz.compiling import LoadedInTime
from pemviz.config import FAMILIES, EncounterConfig
from pemviz.simulators.families import encounter_sight, kernels, vectorized
from pemviz.simulators.families.kernels import PLAIN, compiled_loops, loops_for
from pemviz.simulators.families.vectorized import VectorizedFamily
from pemviz.simulators.latents import salient_of, stepped
from pemviz.simulators.remembering import remembering
from pemviz.simulators.slots import SeenStates, UnrolledSimulator
from tests.simulators.families.courses import SCENARIOS, WIDE, assert_same, steps

CONFIGS = st.builds(
    EncounterConfig,
    family=st.sampled_from(FAMILIES),
    neighbour=st.booleans(),
    side=st.sampled_from(["left", "right"]),
    ghost_probability=st.sampled_from([0.0, 0.1]),
    dt_s=st.floats(0.05, 0.5),
    states=st.integers(2, 14),
    car_length_m=st.floats(1.0, 12.0),
    car_width_m=st.floats(0.5, 2.5),
    path_half_width_m=st.floats(0.5, 3.0),
    camera_half_angle_deg=st.floats(10.0, 70.0),
    farthest_m=st.floats(20.0, 150.0),
    recovery_time_s=st.floats(0.0, 3.0),
    hard_reserve_s=st.floats(0.0, 3.0),
    reaction_time_s=st.floats(0.0, 2.0),
)


@pytest.fixture(params=["as written", "compiled"])
def loops(request):
    """The loops; as written they are slow."""
    if request.param == "as written":
        return PLAIN
    pytest.importorskip("numba")
    found = compiled_loops()
    assert found is not None
    return found


def computed_by(loops, monkeypatch):
    for module in (vectorized, encounter_sight):
        monkeypatch.setattr(module, "loops_for", lambda rows: loops)


def course_by(loops, scenario, count, seed):
    """All states of a course, and what perception depends on at each."""
    with pytest.MonkeyPatch.context() as patch:
        computed_by(loops, patch)
        simulator = remembering(UnrolledSimulator(scenario))
        found = []
        for states, hits, noise in steps(simulator, count=count, seed=seed):
            found.append((states, salient_of(simulator, states)))
            after = stepped(simulator, states, hits, noise)
        return [*found, (after, salient_of(simulator, after))]


def assert_same_courses(loops, scenario, *, count, seed):
    found, expected = (course_by(by, scenario, count, seed) for by in (loops, None))
    for (state, salient), (like, expected_salient) in zip(found, expected, strict=True):
        assert_same(state, like)
        np.testing.assert_array_equal(salient, expected_salient)
    return expected[-1][0]


@pytest.mark.parametrize("name", SCENARIOS)
def test_courses_are_the_same(loops, name):
    """With ghost, tracker, position errors; contacts and far cars among them."""
    last = assert_same_courses(loops, SCENARIOS[name], count=60 if loops is PLAIN else 700, seed=5)
    assert 0.02 < last.signals["collided"].mean() < 0.9
    assert len(np.unique(last.signals["safe_distance"])) > 5


@settings(max_examples=40, deadline=None)
@given(config=CONFIGS, seed=st.integers(0, 1000))
def test_courses_are_the_same_in_any_encounter(config, seed):
    """As written; numbers far beyond the default ones."""
    assert_same_courses(PLAIN, VectorizedFamily(config, WIDE), count=12, seed=seed)


def test_contacts_at_the_very_edge_are_the_same(loops, monkeypatch):
    """Cars that touch at the start, stand, hide each other wholly, or are level."""
    scenario = SCENARIOS["cut-out, neighbour"]
    first = scenario.initial(count=6)
    signals = dict(first.signals)
    signals["gap_lead"] = np.array([0.0, -4.5, 10.0, 10.0, 80.0, np.nextafter(0.0, -1.0)])
    signals["gap_revealed"] = np.array([0.0, 5.0, 10.0, 14.5, 80.0, 3.0])
    signals["aside_revealed"] = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 1.8])
    signals["speed_lead"] = np.array([0.0, 20.0, 0.0, 30.0, 30.0, 20.0])
    states, hits = replace(first, signals=signals), np.ones((6, 3), dtype=np.bool_)
    computed_by(None, monkeypatch)
    expected, like = scenario.step(states, hits), scenario.sight(signals)
    np.testing.assert_array_equal(like.present, scenario.present(signals))
    assert like.salient.shape == (6, 3, 11)  # computed before the loops come
    computed_by(loops, monkeypatch)
    found = scenario.sight(signals)
    assert_same(scenario.step(states, hits), expected)
    np.testing.assert_array_equal(found.salient, like.salient)
    np.testing.assert_array_equal(found.present, like.present)
    assert expected.signals["collided"].any()
    assert not expected.signals["collided"].all()


def test_they_are_loaded_once_numpy_has_taken_as_long(monkeypatch):
    """Few states are left to numpy, until the loops are there."""
    enough = kernels.WORTH_LOADING
    monkeypatch.setattr(kernels, "ROWS_MOVED", LoadedInTime(lambda: PLAIN, enough, enough))
    assert [loops_for(rows) for rows in (enough // 2, enough // 2, 1)] == [None, PLAIN, PLAIN]


def test_without_numba_numpy_computes(monkeypatch):
    """However many states there are, and without a question whether numba has come meanwhile."""
    monkeypatch.setattr(compiling, "is_installed", lambda: False)
    load = cache(compiled_loops.__wrapped__)
    monkeypatch.setattr(kernels, "ROWS_MOVED", LoadedInTime(load, 0, 0))
    assert loops_for(kernels.WORTH_LOADING) is None
    assert load.cache_info().currsize == 1
    states = SCENARIOS["cut-in"].initial(count=2)
    assert isinstance(SCENARIOS["cut-in"].step(states, np.ones((2, 2), np.bool_)), SeenStates)
