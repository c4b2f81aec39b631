"""A run's explanation, on a scenario where every miss weighs the same."""

import numpy as np
import pytest

from pemviz.analysis.explanation import explain
from pemviz.config import ExperimentConfig
from pemviz.proposals.fixed import ConstantProposal
from pemviz.proposals.offset_logistic import SignalFeatures
from pemviz.runs.engine import run_experiment
from pemviz.runs.result_file import result_document
from pemviz.sampling.direct.method import DirectSampling
from tests.toy import exact_failure_probability


def test_elasticity_is_the_derivative_of_the_binomial_tail(toy_problem):
    """Its Monte Carlo error at 50,000 rollouts is below 1 %; 3 % is allowed, the seed is fixed."""
    method = DirectSampling(name="naive", proposal=ConstantProposal(0.5), rollouts=50_000, seed=0)
    _, stage = method.step(toy_problem, method.init(toy_problem, repetition=0))
    features = SignalFeatures(toy_problem.simulator.signals)
    target = exact_failure_probability(steps=6, miss_probability=0.05)
    found = explain(stage, features=features, farthest_m=4.0, target=target, dt_s=0.05)
    assert found is not None
    step = 1e-5
    higher = exact_failure_probability(steps=6, miss_probability=0.1 * np.exp(step))
    lower = exact_failure_probability(steps=6, miss_probability=0.1 * np.exp(-step))
    slope = (np.log(higher) - np.log(lower)) / (2 * step)
    everywhere = found.sensitivity[0]
    assert everywhere.elasticity == pytest.approx(slope, rel=0.03)
    assert everywhere.target_factor == pytest.approx(0.5, rel=0.03)


def test_a_run_explains_itself():
    config = ExperimentConfig(method="naive", final_rollouts=200, target=1e-60)
    result = run_experiment(config)
    assert result.explanation is not None
    document = result_document(result)
    assert len(document["sensitivity"]) == 1 + 8
    assert document["causes"]["misses_by_distance"][0]["low"] == 0.0
    assert len(document["causes"]["miss_probability_by_step"]) == 99
    shares = [chain["share"] for chain in document["causes"]["chains"]]
    assert shares == sorted(shares, reverse=True)
    assert 0.0 < sum(shares) <= 1.0 + 1e-9


def test_nothing_is_explained_where_nothing_failed():
    result = run_experiment(ExperimentConfig(method="monte-carlo", final_rollouts=50))
    assert result.explanation is None
    assert result_document(result)["sensitivity"] is None
