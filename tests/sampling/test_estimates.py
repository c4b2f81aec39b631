"""Weights and their tail by plain formulas and arviz-stats, estimates by a binomial tail."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from arviz_stats.base.array import array_stats
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.start_moves import even_normals
from pemviz.reports.gate import interval_caveats
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.estimates.estimators import (
    REPLICATES,
    StratifiedError,
    log_normal_interval,
    mixture_estimate,
    negative_log_likelihood,
)
from pemviz.sampling.estimates.importance_weights import (
    log_mean_failing_weight,
    log_std_error,
    smoothed_weights,
)
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.estimates.weight_diagnostics import (
    effective_sample_size,
    fitted_shape,
    largest_share,
    pareto_k_hat,
    tail_shape,
)
from pemviz.sampling.method import elite_threshold, elites
from pemviz.sampling.mixture.balance_heuristic import EXPLORATION, PLAIN
from pemviz.sampling.mixture.estimate import replicates
from tests.toy import exact_failure_probability

TRUTH = exact_failure_probability(steps=6, miss_probability=0.1)


def estimate(problem, *, proposal, name, rollouts, seed=0, repetition=0):
    method = DirectSampling(name=name, proposal=proposal, rollouts=rollouts, seed=seed)
    state = method.init(problem, repetition=repetition)
    assert not method.is_done(state)
    for _ in range(method.stages):
        assert not method.is_done(state)
        state, _ = method.step(problem, state)
    assert method.is_done(state)
    return method.estimate(state)


def test_importance_sampling_is_unbiased(toy_problem):
    """Two-sided z-test at 4 standard errors: false alarm 6e-5; the seed is fixed."""
    found = estimate(toy_problem, proposal=ConstantProposal(0.4), name="naive", rollouts=200_000)
    assert found.std_error is not None
    assert abs(found.probability - TRUTH) < 4 * found.std_error
    assert found.std_error < 0.02 * TRUTH


def test_monte_carlo_is_unbiased(toy_problem):
    """Exact binomial test at level 1e-4; the seed is fixed."""
    found = estimate(toy_problem, proposal=PemProposal(), name="monte-carlo", rollouts=100_000)
    assert stats.binomtest(found.failures, 100_000, TRUTH).pvalue > 1e-4
    assert found.ci_low is not None
    assert found.ci_high is not None
    assert found.ci_low < TRUTH < found.ci_high


def test_standard_error_is_the_spread_between_repetitions(toy_problem):
    """Ratio of the mean reported variance to the observed one over 400 repetitions.

    Its relative standard error is about sqrt(2 / 399) = 7 %; 30 % is over 4 of them.
    """
    found = [
        estimate(
            toy_problem, proposal=ConstantProposal(0.4), name="naive", rollouts=400, repetition=r
        )
        for r in range(400)
    ]
    observed = np.var([e.probability for e in found], ddof=1)
    reported = np.mean([(e.std_error or 0.0) ** 2 for e in found])
    assert reported == pytest.approx(observed, rel=0.3)


def test_clopper_pearson_against_the_beta_quantiles(toy_problem):
    found = estimate(toy_problem, proposal=PemProposal(), name="monte-carlo", rollouts=2_000)
    k, n = found.failures, 2_000
    assert k > 0
    assert found.ci_low == pytest.approx(stats.beta.ppf(0.025, k, n - k + 1))
    assert found.ci_high == pytest.approx(stats.beta.ppf(0.975, k + 1, n - k))


def test_no_failure_under_monte_carlo_gives_an_upper_bound_and_a_warning(toy_problem):
    found = estimate(toy_problem, proposal=PemProposal(), name="monte-carlo", rollouts=20)
    assert found.failures == 0
    assert found.probability == 0.0
    assert found.ci_high == pytest.approx(1 - 0.025 ** (1 / 20))
    assert found.std_error is None
    assert found.log10_probability is None
    assert "no failure" in found.warnings[0]


def test_no_failure_under_importance_sampling_bounds_nothing(toy_problem):
    found = estimate(toy_problem, proposal=ConstantProposal(0.999), name="naive", rollouts=20)
    assert found.failures == 0
    assert (found.probability, found.ci_low, found.ci_high) == (0.0, None, None)
    assert "no failure" in found.warnings[0]
    assert interval_caveats(found)


def test_weights_of_sampling_from_the_model_itself_are_one(toy_problem):
    found = estimate(toy_problem, proposal=PemProposal(), name="monte-carlo", rollouts=2_000)
    assert found.ess == pytest.approx(found.failures)
    assert found.max_weight_share == pytest.approx(1 / found.failures)


def test_both_nlls():
    log_p = np.log([0.5, 0.25])
    mean, log_mean = negative_log_likelihood(log_p)
    assert mean == pytest.approx(-(math.log(0.5) + math.log(0.25)) / 2)
    assert log_mean == pytest.approx(-math.log(0.375))
    assert negative_log_likelihood(np.array([])) == (None, None)


def test_log_normal_interval_is_symmetric_on_the_log_scale():
    low, high = log_normal_interval(math.log(1e-15), relative_error=0.5)
    assert low * high == pytest.approx(1e-30)
    assert high / 1e-15 == pytest.approx(math.exp(1.959964 * math.sqrt(math.log(1.25))))


def test_repetitions_give_mean_and_standard_error_between_them(toy_problem):
    found = [
        estimate(
            toy_problem, proposal=ConstantProposal(0.4), name="naive", rollouts=300, repetition=r
        )
        for r in range(8)
    ]
    together = summarise_repetitions(found)
    values = np.array([e.probability for e in found])
    assert together.probability == pytest.approx(values.mean())
    assert together.std_error == pytest.approx(values.std(ddof=1) / math.sqrt(8))
    assert together.log10_probability == pytest.approx(math.log10(values.mean()))
    assert together.failures == sum(e.failures for e in found)
    assert together.rollouts_in_estimate == 8 * 300
    assert together.ess == min(e.ess for e in found if e.ess is not None)
    assert together.nll_mean == pytest.approx(
        sum((e.nll_mean or 0) * e.failures for e in found) / together.failures
    )
    assert summarise_repetitions(found[:1]) is found[0]


def test_repetitions_that_happen_to_agree_are_as_far_off_as_each_says(toy_problem):
    """Estimates with a known error of a tenth, in pairs; of those that agree within 1 %, too.

    By their spread alone 28 % of those intervals hold. Of 2,000 pairs 110 or so agree: the share
    that holds is 95 %, within five standard errors (false alarm: 1e-6).
    """
    one = estimate(toy_problem, proposal=ConstantProposal(0.4), name="naive", rollouts=50)
    generator = np.random.default_rng(8)
    pairs = np.exp(0.1 * generator.standard_normal((2_000, 2)) - 0.005) * 1e-6
    agree, held = list[bool](), list[bool]()
    for pair in pairs:
        both = [replace(one, probability=each, std_error=0.1 * each) for each in pair.tolist()]
        found = summarise_repetitions(both)
        assert found.ci_low is not None
        assert found.ci_high is not None
        agree.append(bool(abs(np.log(pair[0] / pair[1])) < 0.01))
        held.append(found.ci_low <= 1e-6 <= found.ci_high)
    for holding in (np.array(held), np.array(held)[agree]):
        assert holding.mean() > 0.95 - 5.0 * np.sqrt(0.05 * 0.95 / holding.size)


logs = arrays(np.float64, st.integers(2, 30), elements=st.floats(-30, 30))


@given(logs, st.floats(0, 1))
def test_smoothed_weights_are_powers_that_sum_to_one(log_weight, alpha):
    weight = smoothed_weights(log_weight, alpha=alpha)
    assert weight.sum() == pytest.approx(1.0)
    naive = np.exp(log_weight) ** alpha
    np.testing.assert_allclose(weight, naive / naive.sum(), rtol=1e-12)


@given(logs, st.data())
def test_estimate_and_error_agree_with_the_plain_formulas(log_weight, data):
    violated = data.draw(arrays(np.bool_, log_weight.size))
    terms = np.exp(log_weight) * violated
    if not violated.any():
        assert log_mean_failing_weight(log_weight, violated) == -np.inf
        return
    assert np.exp(log_mean_failing_weight(log_weight, violated)) == pytest.approx(terms.mean())
    error = np.std(terms, ddof=1) / np.sqrt(terms.size)
    assert np.exp(log_std_error(log_weight, violated)) == pytest.approx(
        error, rel=1e-6, abs=1e-9 * terms.max()
    )


def test_weights_far_below_double_precision_keep_their_logs():
    log_weight = np.array([-10_000.0, -10_001.0, -9_000.0])
    violated = np.array([True, True, False])
    expected = -10_000.0 + np.log((1.0 + np.exp(-1.0)) / 3.0)
    assert log_mean_failing_weight(log_weight, violated) == pytest.approx(expected, abs=1e-9)
    assert np.isfinite(log_std_error(log_weight, violated))
    assert 1.0 < effective_sample_size(log_weight[violated]) < 2.0


def test_a_huge_weight_of_a_rollout_that_does_not_violate_changes_nothing():
    log_weight = np.array([0.0, 0.0, 5_000.0])
    violated = np.array([True, True, False])
    assert np.exp(log_mean_failing_weight(log_weight, violated)) == pytest.approx(2 / 3)
    assert np.exp(log_std_error(log_weight, violated)) == pytest.approx(1 / 3)


@given(logs)
def test_effective_sample_size_and_share(log_weight):
    weight = np.exp(log_weight)
    assert effective_sample_size(log_weight) == pytest.approx(
        weight.sum() ** 2 / (weight**2).sum(), rel=1e-9
    )
    assert largest_share(log_weight) == pytest.approx(weight.max() / weight.sum(), rel=1e-9)
    assert 1.0 - 1e-9 <= effective_sample_size(log_weight) <= log_weight.size + 1e-9


@given(
    st.lists(st.floats(-10, 10), min_size=1, max_size=200),
    st.sampled_from(["0.95", "0.96", "0.97", "0.98", "0.99"]),
)
def test_threshold_is_the_papers_order_statistic(values, sigma):
    robustness = np.array(values)
    index = min(int(Fraction(sigma) * len(values)), len(values) - 1)  # exact floor
    expected = max(sorted(values, reverse=True)[index], 0.0)
    assert elite_threshold(robustness, sigma=float(sigma)) == expected
    chosen = elites(robustness, threshold=expected)
    assert chosen.sum() == sum(value <= expected for value in values)


def test_a_hundred_rollouts_have_five_elites():
    robustness = np.arange(1.0, 101.0)
    threshold = elite_threshold(robustness, sigma=0.95)
    assert threshold == 5.0
    assert elites(robustness, threshold=threshold).sum() == 5


def by_arviz(log_weight):
    """k-hat of weights; psislw takes log likelihoods, whose negatives are its log weights."""
    with np.errstate(all="ignore"):
        return float(array_stats.psislw(-log_weight)[1])


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(25, 2000),
    spread=st.floats(1e-6, 30.0),
    centre=st.floats(-700.0, 50.0),
    digits=st.integers(0, 15),
)
@settings(deadline=None, max_examples=150)
def test_it_is_arviz_stats_to_the_last_bit(seed, count, spread, centre, digits):
    rng = np.random.default_rng(seed)
    log_weight = centre + np.round(spread * rng.standard_normal(count), digits)  # ties too
    try:
        expected = by_arviz(log_weight)
    except ValueError:
        with pytest.raises(ValueError, match="the same"):
            tail_shape(log_weight)
        return
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(tail_shape(log_weight), expected)


@pytest.mark.parametrize("shape", [0.2, 0.5, 0.9])
def test_the_shape_of_a_pareto_distribution(shape):
    # the estimator's standard deviation is about (1 + k) / sqrt(n): 0.02; false alarms below 1e-6
    uniform = np.random.default_rng(3).random(10_000)
    excess = np.sort(np.expm1(-shape * np.log(uniform)) / shape)
    assert fitted_shape(excess) == pytest.approx(shape, abs=0.1)


def test_where_there_is_no_figure():
    rng = np.random.default_rng(0)
    assert pareto_k_hat(rng.standard_normal(24)) is None  # a tail of four
    assert pareto_k_hat(np.zeros(100)) is None
    pareto_k_hat(np.linspace(-5_000.0, 0.0, 60))  # more than doubles hold: no warning, no crash
    one_alone = np.concatenate([np.full(99, -900.0), [0.0]])
    assert pareto_k_hat(one_alone) == by_arviz(one_alone)
    assert pareto_k_hat(rng.standard_normal(25)) is not None


def test_error_of_strata_is_that_of_plain_formulas():
    """Two strata of independent draws, and one of four sets that are drawn together."""
    generator = np.random.default_rng(0)
    component = np.repeat([0, 1, 5], [40, 1, 80])
    violated = generator.random(121) < 0.6
    violated[40] = True
    weight = generator.lognormal(-30.0, 1.0, 121)
    replicate = replicates(component)
    value = np.where(violated, weight, 0.0)
    sums = [value[41:][place::REPLICATES].sum() for place in range(REPLICATES)]
    parts = np.array([40 * value[:40].var(ddof=1), value[40] ** 2, 4 * np.var(sums, ddof=1)])
    assert parts[2] > 80 * value[41:].var(ddof=1) / 16.0
    found = StratifiedError.of(np.log(weight), violated, component, replicate)
    assert math.exp(found.log_error) == pytest.approx(np.sqrt(parts.sum()) / 121, rel=1e-12)
    freedom = parts.sum() ** 2 / (parts**2 / [39, 1, 3]).sum()
    assert found.degrees_of_freedom == pytest.approx(freedom, rel=1e-12)
    # of those that hold neither the order nor the set is needed
    unknown = np.where(violated, replicate, -1)
    assert StratifiedError.of(np.log(weight), violated, component, unknown) == found
    far = np.where(replicate < 0, -1, 10**12)  # as an edited file has it
    assert math.isfinite(StratifiedError.of(np.log(weight), violated, component, far).log_error)
    plain = StratifiedError.of(np.log(weight), violated, component)
    parts[2] = 80 * value[41:].var(ddof=1)
    assert math.exp(plain.log_error) == pytest.approx(np.sqrt(parts.sum()) / 121, rel=1e-12)
    assert plain.degrees_of_freedom is None
    alike = np.tile(np.log(weight[41:61:4]), (4, 1)).T.ravel()
    four = np.ones(20, dtype=np.bool_), np.full(20, 5), np.arange(20) % REPLICATES
    least = StratifiedError.of(alike, *four).log_error
    assert least == pytest.approx(StratifiedError.of(alike, *four[:2]).log_error - math.log(4.0))
    none = StratifiedError.of(alike, np.zeros(20, dtype=np.bool_), *four[1:])
    assert none == StratifiedError(-math.inf)


def test_rollouts_that_are_drawn_together_have_a_number_in_common():
    """Of fitted proposals with 32 rollouts or more, also where they come in several parts."""
    component = np.array([EXPLORATION] * 40 + [PLAIN] * 40 + [2] * 31 + [3] * 50 + [4] * 3)
    found = replicates(component)
    assert (found[:111] == -1).all()
    assert (found[161:] == -1).all()
    np.testing.assert_array_equal(found[111:161], np.arange(50) % REPLICATES)
    again = replicates(np.concatenate([component, component]))
    for first in (111, 111 + component.size):
        part = again[first : first + 50]
        for one in range(REPLICATES):
            assert len(set(part[one::REPLICATES])) == 1
        assert len(set(part)) == REPLICATES


def test_intervals_of_even_points_hold_as_often_as_they_say():
    """A plane 3 away in two dimensions, starts moved to it six times: 200 times 2,400 points.

    95 % hold, within a false alarm of 1e-6; and they are less than 0.75 as wide as were the points
    independent.
    """
    generator = np.random.default_rng(1)
    component = np.repeat(np.arange(2, 8), 400)
    replicate = replicates(component)
    held, narrower = 0, list[float]()
    for _ in range(200):
        start = np.empty((2_400, 2))
        for each, one in np.ndindex(6, REPLICATES):
            rows = (component == 2 + each) & (replicate == one)
            start[rows] = even_normals(100, 2, generator)
        start[:, 0] += 3.2
        violated = start[:, 0] + 0.2 * start[:, 1] > 3.0 * math.hypot(1.0, 0.2)
        log_weight = 0.5 * (start[:, 0] - 3.2) ** 2 - 0.5 * start[:, 0] ** 2
        either = [
            mixture_estimate(
                method="mixture", log_weight=log_weight, violated=violated, component=component,
                log_p=np.zeros(2_400), frozen_log_weight=log_weight, frozen=slice(0, 2_400),
                adaptation=1.0, replicate=each,
            )
            for each in (replicate, None)
        ]  # fmt: skip
        even, independent = (math.log(one.ci_high / one.ci_low) for one in either)
        held += either[0].ci_low <= stats.norm.sf(3.0) <= either[0].ci_high
        narrower.append(even / independent)
    assert stats.binomtest(held, 200, 0.95).pvalue > 1e-6
    assert np.median(narrower) < 0.75
