"""Networks asked through the compiled loop answer as numpy does, to the last bit."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.lanes import LANES
from pemviz.pem import PemError, load_pem
from pemviz.pem.models import compiled_network
from pemviz.pem.models.compiled_network import ROWS_ASKED, by_loop
from pemviz.pem.models.compiled_network import compiled_network as loops
from pemviz.pem.models.encoding import paper_inputs
from pemviz.pem.models.layers import Layer, forward, packed
from tests.pem.helpers import braking_rows, random_rows

needs_loop = pytest.mark.skipif(
    loops() is None, reason="needs numba, and numpy that multiplies and adds one after the other"
)
shapes = st.lists(st.integers(1, 37), max_size=3)


def network(hidden, generator):
    """Pose statistics and layers of a network with arbitrary numbers."""
    sizes = [14, *hidden, 1]
    layers = tuple(
        Layer(generator.normal(size=(units, given)), generator.normal(size=units))
        for given, units in pairwise(sizes)
    )
    return generator.normal(size=4), generator.uniform(0.1, 9.0, 4), layers


@needs_loop
@given(hidden=shapes, count=st.integers(0, 40), seed=st.integers(0, 2**32 - 1))
@settings(derandomize=True, deadline=None, max_examples=60)
def test_any_network_answers_as_by_numpy(hidden, count, seed):
    numbers = network(hidden, np.random.default_rng(seed))
    rows = random_rows(np.random.default_rng(seed), count)
    mean, std, layers = numbers
    inputs = paper_inputs(rows, pose_mean=mean, pose_std=std, multiple=LANES)
    wanted = forward(layers, inputs)[:count]
    for layout in (rows, np.asfortranarray(rows), np.repeat(rows, 2, axis=0)[::2]):
        np.testing.assert_array_equal(by_loop(layout, packed(*numbers), loops()), wanted)


@needs_loop
@pytest.mark.parametrize("name", ["ml-nn", "lr", "b-nn"])
def test_shipped_networks_answer_the_same_either_way(name):
    pem = load_pem(name)
    rows = np.concatenate(
        [random_rows(np.random.default_rng(1), 1003), braking_rows(np.linspace(-30, 25, 200))]
    )
    with ROWS_ASKED.from_the_start(False):
        by_hand = pem.logit(rows)
    with ROWS_ASKED.from_the_start(True):
        np.testing.assert_array_equal(pem.logit(rows), by_hand)
        np.testing.assert_array_equal(pem.logit(rows[:, None]), by_hand[:, None])
        assert pem.logit(rows[:0]).shape == (0,)


@needs_loop
@pytest.mark.parametrize(
    ("column", "value"), [(9, np.nan), (4, np.inf), (0, 7.0), (0, 0.5), (2, -1.0), (2, 3.0)]
)
def test_rows_that_are_wrong_are_refused_in_the_same_words(column, value):
    pem, rows = load_pem("ml-nn"), random_rows(np.random.default_rng(2), 20)
    rows[13, column] = value
    told = []
    for wanted in (False, True):
        with ROWS_ASKED.from_the_start(wanted), pytest.raises(PemError) as caught:
            pem.logit(rows)
        told.append(str(caught.value))
    assert told[0] == told[1]
    assert "salient row 13" in told[0]


@needs_loop
def test_a_loop_that_rounds_otherwise_is_not_used(monkeypatch):
    assert compiled_network._is_as_numpy(loops())
    monkeypatch.setattr(compiled_network, "_is_as_numpy", lambda loops: False)
    assert loops.__wrapped__() is None


@needs_loop
def test_the_check_sees_a_last_bit(monkeypatch):
    monkeypatch.setattr(
        compiled_network, "by_loop", lambda *given: np.nextafter(by_loop(*given), np.inf)
    )
    assert not compiled_network._is_as_numpy(loops())


def test_without_numba_numpy_answers(monkeypatch):
    monkeypatch.setattr(compiled_network, "is_installed", lambda: False)
    assert loops.__wrapped__() is None


def test_rows_are_counted_once_they_are_known_to_differ():
    pem, rows = load_pem("ml-nn"), random_rows(np.random.default_rng(3), 3000)
    before = ROWS_ASKED.done
    with ROWS_ASKED.from_the_start(False):
        ROWS_ASKED.done = 0.0
        pem.logit(np.tile(rows[:100], (30, 1)))
        assert ROWS_ASKED.done == 100
        pem.logit(rows)
        assert ROWS_ASKED.done == 3100
    assert ROWS_ASKED.done == before
