"""Of very many weighted rollouts a bounded number is learned from, drawn by their weights."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.sampling.mixture.failure_modes import at_most
from tests.lattice_walk import ToyPem
from tests.sampling.test_mixture_exploring import EARLY, probabilities, problem_of, run


@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 300),
    most=st.integers(1, 200),
    spread=st.sampled_from([0.0, 1.0, 6.0]),
)
def test_weight_stays_where_it_is(seed, count, most, spread):
    """Up to each rollout, the weight of those before it is right to within one that is drawn."""
    generator = np.random.default_rng(seed)
    weight = np.exp(spread * generator.normal(size=count)) * (generator.random(count) < 0.7)
    found = at_most(weight, most)
    if np.count_nonzero(weight) <= most:
        assert found is weight
        return
    step = weight.sum() / most
    assert np.count_nonzero(found) <= most
    assert not found[weight == 0.0].any()
    np.testing.assert_allclose(found.sum(), weight.sum(), rtol=1e-12)
    off = np.cumsum(found) - np.cumsum(weight)
    assert np.abs(off).max() <= step * (1.0 + 1e-9)


@pytest.mark.parametrize("most", [40, 10**6])
def test_an_answer_from_bounded_fits_is_right(monkeypatch, most):
    """Within four standard errors of the exact probability: false alarm 6e-5; as from all."""
    monkeypatch.setattr("pemviz.sampling.mixture.fit.MOST_LEARNED", most)
    pem = ToyPem(at_zero=3.0)
    _, truth = probabilities(EARLY, pem)
    estimate, _ = run(problem_of(EARLY, pem))
    assert estimate.failures > 10 * 40
    assert estimate.std_error < 0.2 * truth
    assert abs(estimate.probability - truth) < 4.0 * estimate.std_error
