"""Estimates against a scenario whose answer is a binomial tail."""

import math

import numpy as np
import pytest
from scipy import stats

from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.reports.gate import interval_caveats
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.estimates.estimate import log_normal_interval, negative_log_likelihood
from pemviz.sampling.estimates.importance_weights import pareto_k_hat
from pemviz.sampling.estimates.repetitions import summarise_repetitions
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


@pytest.mark.parametrize("shape", [0.3, 1.5])
def test_pareto_k_hat_finds_the_tail_index(shape):
    """k-hat of 4,000 Pareto draws; its spread there is about 0.1, 0.35 is over 3 of them."""
    weight = stats.genpareto.rvs(shape, size=4_000, random_state=np.random.default_rng(1))
    assert pareto_k_hat(np.log(weight + 1.0)) == pytest.approx(shape, abs=0.35)


def test_pareto_k_hat_is_undefined_for_few_or_equal_weights():
    assert pareto_k_hat(np.zeros(100)) is None
    assert pareto_k_hat(np.array([0.0, 1.0, 2.0])) is None
    pareto_k_hat(np.linspace(-5_000.0, 0.0, 60))  # more than doubles hold: no warning, no crash


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
