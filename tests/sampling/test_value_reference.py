"""The reference, and what is said where an estimate disagrees with it."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from pemviz.proposals.fixed import ConstantProposal
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.estimates.diagnostics import reference_disagreement
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.batches import run_here
from pemviz.sampling.zero_variance import reference as reference_module
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from pemviz.sampling.zero_variance.proposal import averaged
from pemviz.sampling.zero_variance.reference import (
    Reference,
    exact_log_probability,
    reference,
    reference_of_few_states,
)
from pemviz.sampling.zero_variance.values import both_log_likelihoods
from pemviz.types import outcome_log_likelihood
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_recursion,
    toy_robustness,
    toy_unsafe,
    toy_violated,
)

SIMULATOR, PEM = ToySimulator(initial_gap=5, states=20), ToyPem(at_zero=2.5)
TRUTH = toy_probability_by_recursion(SIMULATOR, PEM)
PROBLEM = Problem(
    simulator=SIMULATOR,
    pem=PEM,
    robustness=toy_robustness,
    violated=toy_violated,
    unsafe=toy_unsafe,
)


def estimate_of(method, problem=PROBLEM, *, repetition=0):
    state = method.init(problem, repetition=repetition)
    while not method.is_done(state):
        state, _ = method.step(problem, state)
    return method.estimate(state)


def test_reference_is_the_exact_answer():
    found = reference(PROBLEM, twin=SIMULATOR)
    assert abs(found.probability - TRUTH) < 4 * found.std_error
    assert found.std_error < 1e-3 * TRUTH
    exact = exact_log_probability(PROBLEM, twin=SIMULATOR)
    assert exact is not None
    assert math.exp(exact) == pytest.approx(TRUTH, rel=1e-12)


@dataclass(frozen=True)
class Tabled(ToySimulator):
    """Simulators that differ in arrays, which dataclasses cannot compare."""

    table: np.ndarray = field(default_factory=lambda: np.zeros(2))


@pytest.mark.parametrize(
    ("simulator", "twin", "batches"),
    [
        (ToySimulator(initial_gap=5, states=20), SIMULATOR, 1),
        (Tabled(initial_gap=5, states=20), Tabled(initial_gap=5, states=20), 3),
        (ToySimulator(initial_gap=4, states=20), SIMULATOR, 3),
    ],
)
def test_rollouts_of_a_scenario_that_is_its_own_twin_are_drawn_together(simulator, twin, batches):
    sizes = []

    def run_batches(simulator, pem, tasks):
        tasks = list(tasks)
        sizes.extend(len(task.uniforms) for task in tasks)
        return run_here(simulator, pem, tasks)

    problem = replace(PROBLEM, simulator=simulator, run_batches=run_batches, batch_rollouts=300)
    found = reference(problem, twin=twin, rollouts=700)
    assert len(sizes) == batches
    alone = replace(problem, batch_rollouts=700, run_batches=run_here)
    assert found == reference(alone, twin=twin, rollouts=700)


def test_few_states_are_gone_through_unasked(monkeypatch):
    """The walk has at most 9 states a step, and 20 steps."""
    found = reference_of_few_states(PROBLEM, twin=SIMULATOR)
    assert found == Reference(
        probability=pytest.approx(TRUTH, rel=1e-12),
        std_error=0.0,
        log10_probability=pytest.approx(math.log10(TRUTH), rel=1e-12),
    )
    for most, known in ((SIMULATOR.states * 9, True), (20, False)):
        monkeypatch.setattr(reference_module, "FEW_STATES", most)
        assert (reference_of_few_states(PROBLEM, twin=SIMULATOR) is not None) is known
    assert reference_of_few_states(replace(PROBLEM, unsafe=None), twin=SIMULATOR) is None


def test_what_an_interrupted_run_left_is_not_taken_for_the_reference():
    def finished(repetition, stage):
        pytest.fail(f"asked for repetition {repetition}, stage {stage}")

    resumed = replace(PROBLEM, finished=finished)
    assert reference(resumed, twin=SIMULATOR) == reference(PROBLEM, twin=SIMULATOR)


def disagreement(estimate, known):
    return reference_disagreement(
        estimate, probability=known.probability, std_error=known.std_error
    )


def test_all_methods_agree_with_the_reference():
    known = reference(PROBLEM, twin=SIMULATOR)
    methods = (
        ZeroVarianceSampling(twin=SIMULATOR, rollouts=500, seed=1),
        MixtureSampling(learning_stages=5, rollouts=200, final_rollouts=500, seed=1),
        DirectSampling(name="naive", proposal=ConstantProposal(0.4), rollouts=50_000, seed=1),
    )
    for method in methods:
        assert disagreement(estimate_of(method), known) == ()


def test_disagreement_is_said_in_words():
    found = estimate_of(ZeroVarianceSampling(twin=SIMULATOR, rollouts=500, seed=2))
    wrong = Reference(probability=3 * TRUTH, std_error=0.0, log10_probability=None)
    (warning,) = disagreement(found, wrong)
    assert "0.33 times the reference" in warning.text


@pytest.mark.parametrize("name", ["zero-variance", "mixture"])
def test_results_do_not_depend_on_the_batch_size(name):
    method = (
        ZeroVarianceSampling(twin=SIMULATOR, rollouts=70, seed=3)
        if name == "zero-variance"
        else MixtureSampling(learning_stages=3, rollouts=70, final_rollouts=70, seed=3)
    )
    assert estimate_of(method) == estimate_of(method, replace(PROBLEM, batch_rollouts=11))


def test_repetitions_average_the_unbiased_figures_too():
    method = MixtureSampling(learning_stages=3, rollouts=60, final_rollouts=60, seed=4)
    found = [estimate_of(method, repetition=repetition) for repetition in range(4)]
    summary = summarise_repetitions(found)
    assert summary.probability == pytest.approx(np.mean([e.probability for e in found]))
    expected = np.mean([e.unbiased_probability for e in found])
    assert summary.unbiased_probability == pytest.approx(expected)
    assert summary.unbiased_probability != summary.probability


def test_both_outcomes_at_once_are_as_likely_as_each():
    logit = np.concatenate([[-np.inf, -800.0, 0.0, 800.0, np.inf], np.linspace(-40.0, 40.0, 801)])
    for detected, found in zip((False, True), both_log_likelihoods(logit), strict=True):
        expected = outcome_log_likelihood(logit, np.full(logit.size, detected))
        np.testing.assert_allclose(found, expected, rtol=1e-15, atol=0.0)


def test_cells_are_averaged_by_the_shares_of_their_states():
    keys = np.array([7, -3, 7, 7, -3])
    miss, share = np.array([0.1, 0.4, 0.2, 0.9, 0.8]), np.array([0.5, 0.1, 0.2, 0.1, 0.1])
    table = averaged(keys, log_miss=np.log(share * miss), log_hit=np.log(share * (1.0 - miss)))
    expected = [(0.04 + 0.08) / 0.2, (0.05 + 0.04 + 0.09) / 0.8]
    np.testing.assert_array_equal(table.keys, [-3, 7])
    np.testing.assert_allclose(1.0 / (1.0 + np.exp(table.logit)), expected, rtol=1e-12)
