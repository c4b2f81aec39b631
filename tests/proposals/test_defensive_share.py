"""Mixtures with the error model: how likely they make outcomes, against their definition."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.proposals.offset_logistic import defended, outcome_ratios

LOGITS = st.lists(st.floats(-600.0, 600.0), min_size=1, max_size=30)


def log_chance(miss_logit, missed):
    """Log likelihood of outcomes, given logits of a miss."""
    return -np.logaddexp(0.0, np.where(missed, -miss_logit, miss_logit))


@given(LOGITS, st.integers(0, 2**32), st.floats(1e-6, 0.5))
def test_ratios_are_those_of_the_mixtures_that_outcomes_are_drawn_from(logits, seed, share):
    generator, model = np.random.default_rng(seed), np.array(logits)
    raised = generator.uniform(-12.0, 12.0, model.size)
    missed = generator.random(model.size) < 0.5
    mixture = -defended(-(model + raised), -model, share=share)
    expected = log_chance(mixture, missed) - log_chance(model, missed)
    found = outcome_ratios(model, missed, share=share)(raised)
    # the difference of two large numbers is known to their last digits
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15 * (1 + np.abs(model).max()))


@pytest.mark.parametrize("missed", [False, True])
@pytest.mark.parametrize("model", [-1e100, -800.0, 800.0, 1e100])
@pytest.mark.parametrize("raised", [-12.0, 0.0, 12.0])
def test_no_model_is_too_sure(model, missed, raised):
    """What is all but certain stays so; what is all but impossible changes by the raise itself."""
    share = 0.01
    log_ratio = outcome_ratios(np.array([model]), np.array([missed]), share=share)
    likely = (model > 0.0) == missed
    towards = raised if missed else -raised
    expected = 0.0 if likely else np.log(share + (1.0 - share) * np.exp(towards))
    np.testing.assert_allclose(log_ratio(np.array([raised])), expected, atol=1e-15)
