"""The toy scenario's two exact answers, and methods against them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.problem import Problem
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_enumeration,
    toy_probability_by_recursion,
    toy_robustness,
    toy_violated,
)


@given(
    initial=st.integers(1, 6),
    more=st.integers(0, 3),
    states=st.integers(2, 12),
    at_zero=st.floats(-3.0, 5.0),
    slope=st.floats(-0.5, 0.5),
)
def test_recursion_agrees_with_enumeration(initial, more, states, at_zero, slope):
    simulator = ToySimulator(initial_gap=initial, largest_gap=initial + more, states=states)
    pem = ToyPem(at_zero=at_zero, slope=slope)
    expected = toy_probability_by_enumeration(simulator, pem)
    assert toy_probability_by_recursion(simulator, pem) == pytest.approx(expected, rel=1e-11)


def test_all_misses_are_the_only_way_in_the_shortest_walk():
    simulator, pem = ToySimulator(initial_gap=3, states=4), ToyPem(at_zero=2.0, slope=0.3)
    misses = [1.0 / (1.0 + np.exp(2.0 - 0.3 * gap)) for gap in (3, 2, 1)]
    assert toy_probability_by_recursion(simulator, pem) == pytest.approx(np.prod(misses), rel=1e-13)


def test_monte_carlo_finds_the_exact_answer():
    """z-test at 4 standard errors: false alarm 6e-5; the seed is fixed."""
    simulator, pem = ToySimulator(initial_gap=4), ToyPem(at_zero=0.5)
    problem = Problem(
        simulator=simulator,
        pem=pem,
        robustness=toy_robustness,
        violated=toy_violated,
    )
    method = DirectSampling(name="monte-carlo", proposal=PemProposal(), rollouts=100_000, seed=3)
    state = method.init(problem, repetition=0)
    while not method.is_done(state):
        state, _ = method.step(problem, state)
    found = method.estimate(state)
    truth = toy_probability_by_recursion(simulator, pem)
    assert found.std_error is not None
    assert abs(found.probability - truth) < 4 * found.std_error
