"""The reference, what is said where an estimate disagrees with it, and building that is stopped."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.proposals.fixed import ConstantProposal
from pemviz.proposals.zero_variance import ZeroVarianceProposal
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.estimates.diagnostics import reference_disagreement
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.rollouts.runners import run_here
from pemviz.sampling.zero_variance import reference as reference_module
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from pemviz.sampling.zero_variance.proposal import averaged, build_zero_variance_proposal
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
    toy_problem_of,
    toy_unsafe,
)
from tests.toy import estimate_of

SIMULATOR, PEM = ToySimulator(initial_gap=5, states=20), ToyPem(at_zero=2.5)
TRUTH = toy_probability_by_recursion(SIMULATOR, PEM)
PROBLEM = toy_problem_of(SIMULATOR, PEM)


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
        assert disagreement(estimate_of(method, PROBLEM), known) == ()


def test_disagreement_is_said_in_words():
    found = estimate_of(ZeroVarianceSampling(twin=SIMULATOR, rollouts=500, seed=2), PROBLEM)
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
    assert estimate_of(method, PROBLEM) == estimate_of(method, replace(PROBLEM, batch_rollouts=11))


def test_repetitions_average_the_unbiased_figures_too():
    method = MixtureSampling(learning_stages=3, rollouts=60, final_rollouts=60, seed=4)
    found = [estimate_of(method, PROBLEM, repetition=repetition) for repetition in range(4)]
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


class StopError(Exception):
    pass


class Pause:
    """Counts its calls, and raises at one of them."""

    def __init__(self, *, stop_at: int | None = None):
        self.calls = 0
        self._stop_at = stop_at

    def __call__(self):
        self.calls += 1
        if self.calls == self._stop_at:
            raise StopError


def build(pem, pause) -> ZeroVarianceProposal:
    method = ZeroVarianceSampling(twin=SIMULATOR, rollouts=20, seed=1)
    return method.init(toy_problem_of(SIMULATOR, pem, pause=pause), repetition=0).proposal


def content(proposal: ZeroVarianceProposal) -> list[np.ndarray]:
    sizes = range(len(proposal.coarse_cells))
    tables = [
        cells
        for layer in proposal.tables
        for cells in (layer.states, *(layer.coarse[size] for size in sizes))
    ]
    return [part for cells in tables for part in (cells.keys, cells.logit)]


def assert_same(found: ZeroVarianceProposal, expected: ZeroVarianceProposal):
    assert found.log_probability == expected.log_probability
    assert found.defensive == expected.defensive
    for one, other in zip(content(found), content(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_pause_that_raises_stops_the_build_wherever_it_is():
    """At every single call, from the first to the last; the next build is whole."""
    pem = ToyPem()
    whole = build_zero_variance_proposal(twin=SIMULATOR, pem=pem, unsafe=toy_unsafe)
    counting = Pause()
    assert_same(build(ToyPem(), counting), whole)
    # each of 19 steps has two moves, a merge, and two directions of the recursion
    assert counting.calls > 5 * 19
    for stop_at in range(1, counting.calls + 1):
        pem, pause = ToyPem(), Pause(stop_at=stop_at)  # a model of its own: nothing is kept of it
        with pytest.raises(StopError):
            build(pem, pause)
        assert pause.calls == stop_at
    again = Pause()
    assert_same(build(pem, again), whole)
    assert again.calls == counting.calls


def test_what_was_built_before_outlives_a_build_that_is_stopped():
    first = ToyPem(at_zero=2.0)
    kept = build(first, Pause())
    with pytest.raises(StopError):
        build(ToyPem(at_zero=1.0), Pause(stop_at=9))
    unused = Pause()
    assert_same(build(first, unused), kept)
    assert unused.calls == 0


@pytest.mark.parametrize("answer", [reference, exact_log_probability])
def test_the_reference_stops_too(answer):
    counting = Pause()
    answer(toy_problem_of(SIMULATOR, ToyPem(), pause=counting), twin=SIMULATOR)
    assert counting.calls > 3 * 19
    with pytest.raises(StopError):
        answer(
            toy_problem_of(SIMULATOR, ToyPem(), pause=Pause(stop_at=counting.calls)), twin=SIMULATOR
        )


def test_a_system_without_a_twin_is_gone_through_itself_where_its_states_are_few():
    """Within a fifth of the steps that rollouts took; with latents, or more states, it is not."""
    experiment = build_experiment(
        ExperimentConfig(
            method="mixture", spec=f"always[0,{SIMULATOR.states - 1}] (gap >= 0.5)", seed=3
        ),
        simulator=SIMULATOR,
        pem=ToyPem(),
    )
    result = run(experiment)
    assert experiment.twin is None
    assert result.reference is not None
    exact = toy_probability_by_recursion(SIMULATOR, ToyPem())
    assert result.reference.probability == pytest.approx(exact, rel=1e-9)
    few = replace(experiment.config, stages=1, rollouts=2, final_rollouts=2)
    assert run(build_experiment(few, simulator=SIMULATOR, pem=ToyPem())).reference is None
