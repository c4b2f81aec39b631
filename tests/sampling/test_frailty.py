"""Obstacles that differ: every figure against all chains of outcomes, u integrated densely."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit, ndtr, ndtri

from pemviz.analysis.causes import Failures
from pemviz.analysis.outcome_likelihood import FrailOutcomes
from pemviz.arrays import row_sums
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import ConfigError
from pemviz.pem.models.memory import Memory, VisibilityNodes, log_sums
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.offset_logistic import SignalFeatures
from pemviz.reports.terminal import summary_text
from pemviz.runs.engine import run_experiment
from pemviz.runs.experiment import build_experiment
from pemviz.runs.model_comparison import compare_models
from pemviz.runs.uncertainty import uncertainty_budget
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.problem import sample
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.state import visibility
from pemviz.sampling.state.composed import ComposedSimulator, as_member, proposal_features
from pemviz.sampling.state.visibility import NEXT, Visibility
from pemviz.sampling.zero_variance.frail import FrailModel, build_frail_proposal
from pemviz.sampling.zero_variance.method import with_absorbing_violation
from pemviz.sampling.zero_variance.proposal import with_defence
from pemviz.sampling.zero_variance.reference import exact_log_probability, reference
from pemviz.types import RolloutBatch, outcome_log_likelihood
from tests.faults.test_resume import stopped_and_whole
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_problem_of,
    toy_unsafe,
)
from tests.sampling.test_memory import with_memory
from tests.toy import estimate_of, splitting_runs, subset_runs

SIMULATOR, PEM = ToySimulator(initial_gap=4, largest_gap=6, states=9), ToyPem(at_zero=2.5)
CHAINS = np.array(list(itertools.product((False, True), repeat=SIMULATOR.states - 1)))
MEMORIES = [Memory(0.0, 0.5), Memory(1.0, 0.5), Memory(0.0, 2.0), Memory(5.0, 1.0)]
"""The walk takes 1 s a step."""


def by_enumeration(memory, *, factor=1.0, pem=PEM):
    """All chains' probabilities one by one; misses ``factor`` times as likely; who violates."""
    u = np.arange(-14.0, 14.0, 0.05)
    weight = np.exp(-0.5 * u**2) / np.exp(-0.5 * u**2).sum()
    rho = math.exp(-1.0 / memory.tau_s) if memory.tau_s else 0.0
    probabilities, violates = [], []
    for chain in CHAINS:
        gap, given_u, before, failed = SIMULATOR.initial_gap, weight, None, False
        for detected in chain:
            p = factor * float(expit(-pem.logit(np.array([float(gap)]))))
            miss = ndtr(ndtri(p) * math.sqrt(1.0 + memory.frailty**2) + memory.frailty * u)
            if before is not None:
                miss = miss + ((0.0 if before else 1.0) - miss) * rho
            given_u = given_u * (1.0 - miss if detected else miss)
            gap = min(gap + 1, SIMULATOR.largest_gap) if detected else gap - 1
            failed, before = failed or gap <= 0, detected
        probabilities.append(given_u.sum())
        violates.append(failed)
    return np.array(probabilities), np.array(violates)


def frail_problem(memory, pem=PEM):
    back_end = BackEnd(SIMULATOR, SignalFeatures(SIMULATOR.signals), SIMULATOR, 4096)
    back_end, model = with_memory(back_end, pem, memory=memory)
    return toy_problem_of(back_end.simulator, model), back_end


def all_rollouts(problem):
    """The rollouts of all chains, with the logits that the scenario's states carry."""
    signals = replay(simulator=problem.simulator, detected=CHAINS)
    salient = problem.simulator.salient({name: v[:, :-1] for name, v in signals.items()})
    logit = problem.pem.logit(salient)
    return RolloutBatch(signals, {}, CHAINS, logit, logit), salient


@pytest.mark.parametrize("memory", MEMORIES)
def test_chains_have_the_probabilities_of_an_integral_over_the_obstacle(memory):
    probabilities, violates = by_enumeration(memory)
    problem, back_end = frail_problem(memory)
    rollouts, salient = all_rollouts(problem)
    recursion = exact_log_probability(problem, twin=back_end.twin)
    assert recursion is not None
    assert math.exp(recursion) == pytest.approx(probabilities[violates].sum(), rel=1e-11)
    found = np.exp(row_sums(outcome_log_likelihood(rollouts.pem_logit, CHAINS)))
    np.testing.assert_allclose(found, probabilities, rtol=1e-9, atol=1e-15)
    assert found[violates].sum() == pytest.approx(probabilities[violates].sum(), rel=1e-11)
    assert found.sum() == pytest.approx(1.0, rel=1e-12)
    assert problem.pem.log_likelihood(salient, CHAINS) == pytest.approx(np.log(found), rel=1e-10)


def test_another_models_likelihood_does_not_rest_on_what_the_state_knows():
    """As when refits and other model classes are asked with the same rollouts."""
    memory, other = MEMORIES[1], ToyPem(at_zero=1.0)
    problem, _ = frail_problem(memory)
    _, salient = all_rollouts(problem)
    member = as_member(other, like=problem.pem)
    asked = member.log_likelihood(salient, CHAINS)
    probabilities, _ = by_enumeration(memory, pem=other)
    np.testing.assert_allclose(np.exp(asked), probabilities, rtol=1e-9, atol=1e-15)
    under, _ = all_rollouts(problem.under(other))
    found = row_sums(outcome_log_likelihood(under.pem_logit, CHAINS))
    np.testing.assert_allclose(found, asked, rtol=1e-9)
    with pytest.raises(TypeError, match="depends on all outcomes"):
        member.logit(salient)
    with pytest.raises(ValueError, match="are replaced together"):
        replace(problem, pem=other)
    with pytest.raises(ValueError, match="are replaced together"):
        replace(problem, simulator=SIMULATOR)


@pytest.mark.parametrize("memory", MEMORIES[1:2])
def test_every_method_agrees_with_all_chains(memory):
    """Seeds are fixed; five standard errors, a false alarm in 1e6 for each."""
    probabilities, violates = by_enumeration(memory)
    truth = probabilities[violates].sum()
    problem, back_end = frail_problem(memory)
    features = proposal_features(back_end.features)
    for method in (
        DirectSampling(name="monte-carlo", proposal=PemProposal(), rollouts=5_000, seed=1),
        DirectSampling(name="naive", proposal=ConstantProposal(0.5), rollouts=2_000, seed=1),
        MixtureSampling(
            learning_stages=4, rollouts=100, final_rollouts=500, seed=1, features=features
        ),
        splitting_runs(stages=10, rollouts=100, seed=1),
        subset_runs(stages=10, rollouts=300, seed=1),
    ):
        found = estimate_of(method, problem)
        assert found.std_error is not None
        assert abs(found.probability - truth) < 5 * found.std_error, method.name
        assert found.std_error < 0.25 * truth


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_value_function_steers_with_next_to_no_variance(memory):
    """Without a defensive share every rollout violates, with the probability as its weight.

    But for the interpolation between nodes. Seeds are fixed; elsewhere five standard errors, a
    false alarm in 1e6 for each.
    """
    probabilities, violates = by_enumeration(memory)
    truth = probabilities[violates].sum()
    problem, back_end = frail_problem(memory)
    exact, merged = (
        build_frail_proposal(
            twin=back_end.twin,
            model=FrailModel.of(problem.pem),
            unsafe=toy_unsafe,
            largest_layer=size,
        )
        for size in (100, 3)
    )
    assert exact.exact
    assert not merged.exact
    drawn = sample(
        with_absorbing_violation(problem),
        proposal=with_defence(exact, defensive_steps=1e-9, steps=8),
        count=200,
        seeds=np.random.SeedSequence(1),
    )
    assert drawn.violated.all()
    np.testing.assert_allclose(np.exp(drawn.rollouts.log_weight), truth, rtol=0.05)
    known = reference(problem, twin=back_end.twin, rollouts=1_000)
    assert abs(known.probability - truth) < 5 * known.std_error
    method = DirectSampling(name="naive", proposal=merged, rollouts=1_000, seed=1)
    found = estimate_of(method, with_absorbing_violation(problem))
    assert found.std_error is not None
    assert abs(found.probability - truth) < 5 * found.std_error


def test_models_are_not_compared_with_frailty():
    with pytest.raises(ConfigError, match=r"frailty = 0\.5: models are compared") as caught:
        compare_models(SHORT, ["ml-nn", "lr"], rollouts=10)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("memory", MEMORIES)
def test_sensitivities_are_the_derivatives_of_the_answer(memory):
    problem, _ = frail_problem(memory)
    rollouts, _ = all_rollouts(problem)
    probabilities, violates = by_enumeration(memory)
    truth = probabilities[violates].sum()
    chosen = np.flatnonzero(violates)
    failures = Failures(
        rollouts.take(chosen),
        chosen,
        probabilities[chosen] / truth,
        np.ones((chosen.size, SIMULATOR.states - 1), dtype=np.bool_),
    )
    likelihood = FrailOutcomes.of(
        failures.rollouts, system=problem.simulator, visibility=problem.pem.properties[-1]
    )

    def answer(**changed):
        other = replace(memory, tau_s=changed.get("tau_s", memory.tau_s))
        return by_enumeration(other, factor=changed.get("factor", 1.0))[0][violates].sum()

    step = 1e-4
    rise = (answer(factor=1 + step) - answer(factor=1 - step)) / (2 * step * truth)
    assert failures.share @ likelihood.slope().sum(axis=1) == pytest.approx(rise, rel=1e-6)
    inside = np.ones_like(failures.deciding)
    rarer = np.exp(likelihood.log_change_within(inside, factor=0.3))
    assert failures.share @ rarer == pytest.approx(answer(factor=0.3) / truth, rel=1e-9)
    if memory.tau_s:
        up, down = (answer(tau_s=memory.tau_s * (1 + s)) for s in (step, -step))
        rise = (up - down) / (2 * step * truth)
        found = failures.share @ likelihood.slope_of_tau().sum(axis=1)
        assert found == pytest.approx(rise, rel=1e-6)
        shorter = np.exp(likelihood.log_change_of_tau_within(inside, factor=0.5))
        expected = answer(tau_s=0.5 * memory.tau_s) / truth
        assert failures.share @ shorter == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("frailty", [0.05, 0.5, 1.0, 3.0, 5.0])
def test_the_mean_over_obstacles_is_the_models_own(frailty):
    own = np.array([-50.0, -34.5, -10.0, 0.0, 2.0, 10.0, 34.5, 50.0])
    nodes = VisibilityNodes(frailty)
    miss, hit = (log_sums(each + nodes.log_weight) for each in nodes.log_outcomes(own))
    np.testing.assert_allclose(miss, -np.logaddexp(0.0, own), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(hit, -np.logaddexp(0.0, -own), rtol=1e-9, atol=1e-12)


def test_rollouts_do_not_depend_on_how_many_are_drawn_together():
    problem, _ = frail_problem(MEMORIES[1])
    seeds = np.random.SeedSequence(4)
    one, other = (
        sample(
            replace(problem, batch_rollouts=size), proposal=PemProposal(), count=600, seeds=seeds
        )
        for size in (600, 7)
    )
    np.testing.assert_array_equal(one.rollouts.pem_logit, other.rollouts.pem_logit)
    assert NEXT not in one.rollouts.memory


SHORT = ExperimentConfig(
    method="mixture", stages=2, rollouts=40, final_rollouts=60, memory_s=0.2, frailty=0.5, seed=3,
    spec="always[0,59] (gap >= 6.0)", scenario=ScenarioConfig(states=60), measured_memory=False,
)  # fmt: skip


def test_states_that_are_alike_are_asked_once_with_the_same_bits(monkeypatch):
    for memory in MEMORIES[:2]:
        problem, drawn = frail_problem(memory)[0], []
        for fewest in (visibility.FEWEST, 10**9):
            monkeypatch.setattr(visibility, "FEWEST", fewest)
            drawn.append(
                sample(problem, proposal=PemProposal(), count=1500,
                       seeds=np.random.SeedSequence(2)).rollouts
            )  # fmt: skip
        alike, one_by_one = drawn
        assert len(np.unique(alike.pem_logit[:, -1])) > 10
        np.testing.assert_array_equal(alike.pem_logit, one_by_one.pem_logit)
        for name, values in one_by_one.signals.items():
            np.testing.assert_array_equal(alike.signals[name], values, err_msg=name)


def test_a_stopped_run_with_frailty_goes_on_to_the_same_bytes(tmp_path):
    config = replace(SHORT, spec="always[0,8] (gap >= 0.5)")
    experiment = build_experiment(config, simulator=SIMULATOR, twin=SIMULATOR, pem=PEM)
    stopped_and_whole(experiment, tmp_path, 1)


def test_a_run_says_what_it_assumes_and_asks_refits_and_model_classes():
    result = run_experiment(SHORT)
    assert result.memory is not None
    assert (result.memory.tau_s, result.memory.frailty) == (0.2, 0.5)
    assert "frailty 0.5" in " ".join(result.assumptions)
    assert result.pem_interval is not None
    assert result.model_classes
    assert result.explanation is not None
    assert result.explanation.memory is not None
    assert "frailty 0.5" in summary_text(result)
    (source,) = (source for source in uncertainty_budget(result) if source.kind == "memory")
    assert "0.2 s, frailty 0.5 assumed" in source.name
    assert source.narrowed_by == "--memory-curve"


@pytest.mark.parametrize("frailty", [5.1, -0.1, math.nan])
def test_what_does_not_hold_is_refused_in_one_line(frailty):
    with pytest.raises(ConfigError, match=f"frailty = {frailty}") as caught:
        build_experiment(replace(SHORT, frailty=frailty))
    assert "\n" not in str(caught.value)


def test_a_signal_of_that_name_is_refused_in_one_line():
    problem, back_end = frail_problem(MEMORIES[0])
    twice = replace(back_end, simulator=problem.simulator, twin=None)
    with pytest.raises(ConfigError, match="'visibility' is pemviz's own") as caught:
        with_memory(twice, PEM, memory=MEMORIES[0])
    assert "\n" not in str(caught.value)
    assert isinstance(problem.simulator, ComposedSimulator)
    assert isinstance(problem.simulator.components[-1], Visibility)
