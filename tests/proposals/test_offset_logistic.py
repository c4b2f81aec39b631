"""Generalised linear proposals and their fit, against definitions and a general optimiser."""

from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

from pemviz.proposals.defensive import defended
from pemviz.proposals.offset_logistic import (
    LARGEST_SHIFT,
    OffsetLogisticProposal,
    PolynomialBasis,
    SignalFeatures,
    outcome_ratios,
)
from pemviz.proposals.offset_logistic_fit import (
    LogisticFit,
    WeightedOutcomes,
    fit_offset_logistic,
    group_sums,
    leave_one_out_loss,
)
from pemviz.types import VIOLATED, StateBatch
from tests.lattice_walk import ToySimulator

NO_RIDGE = 1e-9


def outcomes(*, basis, missed, offset, weight):
    return WeightedOutcomes(
        basis=np.asarray(basis, dtype=float),
        missed=np.asarray(missed, dtype=bool),
        offset=np.asarray(offset, dtype=float),
        weight=np.asarray(weight, dtype=float),
    )


@given(
    share=st.floats(0.02, 0.98),
    offset=st.floats(-8.0, 8.0),
    weight=st.floats(0.5, 50.0),
)
def test_a_constant_fits_the_weighted_share_of_misses(share, offset, weight):
    """Without a penalty: offset + constant = logit of the share."""
    data = outcomes(
        basis=[[1.0], [1.0]],
        missed=[True, False],
        offset=[offset, offset],
        weight=[weight * share, weight * (1 - share)],
    )
    fit = fit_offset_logistic(data, ridge=np.array([NO_RIDGE]), start=np.zeros(1))
    assert offset + fit.coefficients[0] == pytest.approx(logit(share), abs=0.1)


def test_a_strong_penalty_keeps_the_error_model():
    data = outcomes(basis=[[1.0]] * 4, missed=[True] * 4, offset=[-3.0] * 4, weight=[1.0] * 4)
    fit = fit_offset_logistic(data, ridge=np.array([1e9]), start=np.zeros(1))
    assert abs(fit.coefficients[0]) < 1e-6


def test_fit_recovers_known_coefficients():
    """40,000 draws: coefficients within 5 standard errors (false alarm 2e-6); fixed seed."""
    generator = np.random.default_rng(5)
    basis = np.column_stack([np.ones(40_000), generator.normal(size=(40_000, 2))])
    offset = generator.normal(-1.0, 1.0, size=40_000)
    truth = np.array([0.7, -0.5, 0.3])
    missed = generator.random(40_000) < expit(offset + basis @ truth)
    data = outcomes(basis=basis, missed=missed, offset=offset, weight=np.ones(40_000))
    fit = fit_offset_logistic(data, ridge=np.full(3, NO_RIDGE), start=np.zeros(3))
    errors = np.sqrt(np.diag(np.linalg.inv(fit.curvature)))
    assert (np.abs(fit.coefficients - truth) < 5 * errors).all()


@given(st.lists(st.integers(0, 9), max_size=60), st.integers(0, 2**32))
def test_sums_of_groups_are_those_of_adding_up(groups, seed):
    group = np.sort(np.array(groups, dtype=np.int64))
    values = np.random.default_rng(seed).normal(size=(group.size, 3))
    expected = np.zeros((12, 3))
    np.add.at(expected, group, values)
    np.testing.assert_allclose(group_sums(values, group, count=12), expected, atol=1e-13)


def test_other_weights_are_another_fit():
    """What is carried over to a fit of other weights is what it would come to by itself."""
    generator = np.random.default_rng(8)
    basis = np.column_stack([np.ones(50), generator.normal(size=50)])
    given_weights = [generator.random(50) for _ in range(2)]
    fits = [
        LogisticFit(
            np.array([0.3, -0.2]),
            outcomes(basis=basis, missed=basis[:, 1] > 0, offset=np.full(50, -1.0), weight=weight),
            np.full(2, 0.1),
        )
        for weight in given_weights
    ]
    assert fits[0].improved() is not fits[0]  # it has computed everything
    carried = fits[0].reweighted(given_weights[1])
    assert carried.summed_loss == fits[1].summed_loss != fits[0].summed_loss
    np.testing.assert_array_equal(carried.improved().coefficients, fits[1].improved().coefficients)


def test_a_good_enough_fit_is_kept_while_weights_hardly_change():
    generator = np.random.default_rng(9)
    basis = np.column_stack([np.ones(80), generator.normal(size=80)])
    missed, weight = generator.random(80) < 0.4, generator.random(80)

    def data(weight):
        return outcomes(basis=basis, missed=missed, offset=np.full(80, -0.5), weight=weight)

    ridge = np.full(2, 0.1)
    fit = fit_offset_logistic(data(weight), ridge=ridge, start=np.zeros(2))
    assert fit.improved() is fit
    assert fit.adapted(weight * (1.0 + 1e-6)) is fit
    other = generator.random(80)
    fresh = LogisticFit(fit.coefficients, data(other), ridge).improved()
    adapted = fit.adapted(other)
    assert adapted is not fit
    np.testing.assert_array_equal(adapted.coefficients, fresh.coefficients)
    np.testing.assert_array_equal(adapted.outcomes.weight, other)


def test_leave_one_out_agrees_with_fitting_again():
    generator = np.random.default_rng(6)
    group = np.repeat(np.arange(60), 20)
    basis = np.column_stack([np.ones(1200), generator.normal(size=1200)])
    offset = np.full(1200, -0.5)
    missed = generator.random(1200) < 0.5
    data = outcomes(basis=basis, missed=missed, offset=offset, weight=np.ones(1200))
    ridge, start = np.full(2, 0.1), np.zeros(2)
    fit = fit_offset_logistic(data, ridge=ridge, start=start)
    first_order = leave_one_out_loss(fit, group=group, count=60)

    def log_likelihood(coefficients, chosen):
        raised = offset[chosen] + basis[chosen] @ coefficients
        return -np.logaddexp(0.0, np.where(missed[chosen], -raised, raised)).sum()

    for left_out in range(0, 60, 7):
        kept = group != left_out
        again = fit_offset_logistic(
            outcomes(
                basis=basis[kept],
                missed=missed[kept],
                offset=offset[kept],
                weight=np.ones(kept.sum()),
            ),
            ridge=ridge,
            start=start,
        )
        fall = log_likelihood(fit.coefficients, ~kept) - log_likelihood(again.coefficients, ~kept)
        assert first_order[left_out] == pytest.approx(fall, rel=0.25, abs=3e-3)


def toy_proposal(coefficients):
    basis = PolynomialBasis(mean=np.array([4.0, 5.0]), spread=np.array([2.0, 3.0]), degree=1)
    return OffsetLogisticProposal(
        features=SignalFeatures(ToySimulator().signals),
        basis=basis,
        coefficients=np.asarray(coefficients, dtype=float),
        violated=VIOLATED,
        defensive=1e-12,
    )


def test_shift_is_the_polynomial_of_standardised_features():
    states = StateBatch(step=np.array(8), signals={"gap": np.array([2.0, 6.0])})
    found = toy_proposal([1.0, 0.5, 0.25]).logit(states, np.array([3.0, 3.0]))
    np.testing.assert_allclose(found, 3.0 - (1.0 + 0.5 * np.array([-1.0, 1.0]) + 0.25))


def test_shift_is_bounded_and_stops_at_a_violation():
    states = StateBatch(
        step=np.array(8),
        signals={"gap": np.array([2.0, 6.0])},
        memory={VIOLATED: np.array([False, True])},
    )
    found = toy_proposal([1e6, 0.0, 0.0]).logit(states, np.array([3.0, 3.0]))
    np.testing.assert_allclose(found, [3.0 - LARGEST_SHIFT, 3.0], rtol=1e-6)


@given(degree=st.integers(0, 4), features=st.integers(1, 3))
def test_number_of_monomials(degree, features):
    basis = PolynomialBasis(mean=np.zeros(features), spread=np.ones(features), degree=degree)
    assert len(basis.exponents) == comb(degree + features, features)


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


def test_a_logit_that_is_no_number_stays_one_without_a_warning():
    logit = np.array([np.nan, 0.0, 2.0])
    for of_proposal, of_model in ((logit, np.zeros(3)), (np.zeros(3), logit)):
        found = defended(of_proposal, of_model, share=0.1)
        assert np.isnan(found).tolist() == [True, False, False]
