"""Misses in bursts: the answer of every method against all chains of outcomes, one by one."""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import expit

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import ConfigError, InputError
from pemviz.pem.models.memory import Memory
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.offset_logistic import SignalFeatures
from pemviz.runs.engine import run, run_experiment
from pemviz.runs.experiment import build_experiment
from pemviz.runs.run_folder import record
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.problem import sample
from pemviz.sampling.state.composed import (
    ComposedPem,
    ComposedSimulator,
    composed,
    properties_of_memory,
)
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.sampling.zero_variance.reference import exact_log_probability, reference
from pemviz.types import LAST_OUTCOME, Signal
from tests.faults.test_resume import stopped_and_whole
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_problem_of,
)
from tests.toy import ConstantPem, MissCounter, estimate_of, splitting_runs, subset_runs

SIMULATOR, PEM = ToySimulator(initial_gap=4, largest_gap=6, states=13), ToyPem(at_zero=2.5)
TAUS_S = (0.3, 1.0, 5.0, 60.0)
"""The walk takes 1 s a step."""


def by_enumeration(simulator, pem, *, tau_s):
    """The sum over all chains of outcomes of their probabilities, in plain numbers."""
    rho = math.exp(-simulator.dt_s / tau_s) if tau_s else 0.0
    total = 0.0
    for chain in itertools.product((False, True), repeat=simulator.states - 1):
        gap, probability, before, failed = simulator.initial_gap, 1.0, None, False
        for detected in chain:
            miss = float(expit(-pem.logit(np.array([float(gap)]))))
            if before is not None:
                miss += ((0.0 if before else 1.0) - miss) * rho
            probability *= 1.0 - miss if detected else miss
            gap = min(gap + 1, simulator.largest_gap) if detected else gap - 1
            failed, before = failed or gap <= 0, detected
        total += probability * failed
    return total


def with_memory(back_end, pem, *, memory):
    """Back end and error model whose misses hang together."""
    properties = properties_of_memory(memory, simulator=back_end.simulator)
    return composed(back_end, pem, properties=properties)


def remembering_problem(tau_s, simulator=SIMULATOR, pem=PEM):
    back_end = BackEnd(simulator, SignalFeatures(simulator.signals), simulator, 4096)
    back_end, pem = with_memory(back_end, pem, memory=Memory(tau_s=tau_s))
    return toy_problem_of(back_end.simulator, pem), back_end


@pytest.mark.parametrize("tau_s", [0.0, *TAUS_S])
def test_the_recursion_is_exact(tau_s):
    problem, back_end = remembering_problem(tau_s)
    found = exact_log_probability(problem, twin=back_end.twin)
    assert found is not None
    assert math.exp(found) == pytest.approx(by_enumeration(SIMULATOR, PEM, tau_s=tau_s), rel=1e-11)


@pytest.mark.parametrize("tau_s", TAUS_S)
def test_every_method_agrees_with_all_chains(tau_s):
    """Seeds are fixed; five standard errors, a false alarm in 1e6 for each."""
    truth = by_enumeration(SIMULATOR, PEM, tau_s=tau_s)
    problem, back_end = remembering_problem(tau_s)
    known = reference(problem, twin=back_end.twin)
    assert abs(known.probability - truth) < 5 * known.std_error + 1e-9 * truth
    for method in (
        DirectSampling(name="monte-carlo", proposal=PemProposal(), rollouts=100_000, seed=1),
        MixtureSampling(
            learning_stages=4, rollouts=200, final_rollouts=2000, seed=1, features=back_end.features
        ),
        splitting_runs(stages=20, rollouts=200, seed=1),
        subset_runs(stages=20, rollouts=400, seed=1),
    ):
        found = estimate_of(method, problem)
        assert found.std_error is not None
        assert abs(found.probability - truth) < 5 * found.std_error, method.name


def test_how_often_it_misses_does_not_depend_on_the_memory():
    """In a constant state: mean and correlations within five standard errors."""
    steps, count, miss = 40, 40_000, 0.2
    simulator, pem = MissCounter(states=steps + 1), ConstantPem(miss_probability=miss)
    problem, _ = remembering_problem(0.3, simulator, pem)
    drawn = sample(problem, proposal=PemProposal(), count=count, seeds=np.random.SeedSequence(1))
    missed = (~drawn.rollouts.detected).astype(float)
    error = math.sqrt(miss * (1 - miss) / count)
    assert np.abs(missed.mean(axis=0) - miss).max() < 5 * error
    for lag in (1, 3, 8):
        pairs = (missed[:, 0] - miss) * (missed[:, lag] - miss) / (miss * (1 - miss))
        expected = math.exp(-lag * simulator.dt_s / 0.3)
        assert abs(pairs.mean() - expected) < 5 * pairs.std() / math.sqrt(count)


def test_without_memory_nothing_is_wrapped():
    experiment = build_experiment(ExperimentConfig())
    assert not isinstance(experiment.problem.simulator, ComposedSimulator)
    assert not isinstance(experiment.pem, ComposedPem)


@pytest.mark.parametrize("logit", [-700.0, -30.0, 0.0, 30.0, 700.0])
def test_likelihoods_stay_finite_however_long_the_memory(logit):
    pem = ComposedPem(ConstantLogit(logit), (LastOutcome(60.0, 0.001),))
    found = pem.logit(np.array([[0.0, -1.0], [0.0, 0.0], [0.0, 1.0]]))
    assert np.isfinite(found).all()
    assert found[1] == logit
    rest = -math.expm1(-0.001 / 60.0)
    if logit == 700.0:  # it misses only because it missed before
        assert found[0] == pytest.approx(math.log(rest) - math.log1p(-rest), rel=1e-9)
    if logit == -700.0:  # it detects only because it did before
        assert found[2] == pytest.approx(math.log1p(-rest) - math.log(rest), rel=1e-9)


@pytest.mark.parametrize(("tau_s", "leaves"), [(0.02, True), (0.05, False)])
def test_a_proposal_leaves_what_the_scenario_ignores_to_a_short_memory(tau_s, leaves):
    experiment = build_experiment(replace(SHORT, memory_s=tau_s))
    drawn = sample(
        experiment.problem, proposal=PemProposal(), count=5, seeds=np.random.SeedSequence(3)
    )
    states = drawn.rollouts.decision_states()
    own = experiment.back_end.scenario_alone.features.reacts(states)
    assert own.any()
    assert not own.all()
    acts = experiment.method.features.reacts(states)
    np.testing.assert_array_equal(acts, own if leaves else np.ones_like(own))
    assert experiment.features.reacts(states).all()  # to the analysis all outcomes matter


@dataclass(frozen=True)
class ConstantLogit:
    value: float
    name: str = "constant"
    digest: str = ""
    data: str = "nothing"
    licence: str = "none"

    def logit(self, salient):
        return np.full(salient.shape[:-1], self.value)


@dataclass(frozen=True)
class Named(ToySimulator):
    @property
    def signals(self):
        return (*super().signals, Signal("last_outcome", "last", "", 0.0, 1.0))

    def initial(self, *, count):
        states = super().initial(count=count)
        return replace(states, signals={**states.signals, "last_outcome": np.zeros(count)})

    def step(self, states, detected):
        after = super().step(states, detected)
        return replace(
            after, signals={**after.signals, "last_outcome": states.signals["last_outcome"]}
        )


def test_a_simulator_with_a_signal_of_that_name_is_refused_in_one_line():
    config = ExperimentConfig(method="mixture", spec="always[0,12] (gap >= 0.5)", memory_s=1.0)
    with pytest.raises(ConfigError, match="'last_outcome' is pemviz's own") as caught:
        build_experiment(config, simulator=Named(states=13), pem=PEM)
    assert "\n" not in str(caught.value)


def test_ones_own_simulator_and_detector_remember_too():
    config = ExperimentConfig(
        method="zero-variance",
        spec="always[0,12] (gap >= 0.5)",
        final_rollouts=200,
        memory_s=2.0,
        reference=True,
    )
    experiment = build_experiment(config, simulator=SIMULATOR, twin=SIMULATOR, pem=PEM)
    result = run(experiment)
    truth = by_enumeration(SIMULATOR, PEM, tau_s=2.0)
    assert result.estimate is not None
    assert result.reference is not None
    known = result.reference
    assert abs(known.probability - truth) < 5 * known.std_error
    assert result.estimate.ci_low <= truth <= result.estimate.ci_high
    assert "memory time of 2 s" in " ".join(result.assumptions)
    assert result.memory is not None
    assert result.memory.tau_s == 2.0


SHORT = ExperimentConfig(
    method="mixture", stages=2, rollouts=40, final_rollouts=60, memory_s=0.2, seed=3,
    epochs=20, spec="always[0,59] (gap >= 6.0)", scenario=ScenarioConfig(states=60),
    measured_memory=False,
)  # fmt: skip


@pytest.mark.parametrize("method", ["mixture", "adaptive"])
def test_a_stopped_run_with_memory_goes_on_to_the_same_bytes(method, tmp_path):
    experiment = build_experiment(replace(SHORT, method=method))
    *_, parts = stopped_and_whole(experiment, tmp_path, 1, 2)
    other = build_experiment(replace(SHORT, method=method, memory_s=0.1))
    with pytest.raises(InputError, match=r"memory_s = 0\.2, not 0\.1"):
        record(other, parts)


def test_both_back_ends_give_the_same_rollouts_with_memory():
    found = [
        run_experiment(replace(SHORT, simulator=name)) for name in ("vectorized", "highway-env")
    ]
    one, other = (result.estimate for result in found)
    assert one is not None
    assert other is not None
    assert other.probability == pytest.approx(one.probability, rel=1e-6)


def test_rollouts_say_what_the_last_outcome_was():
    experiment = build_experiment(SHORT)
    drawn = sample(
        experiment.problem, proposal=PemProposal(), count=50, seeds=np.random.SeedSequence(2)
    ).rollouts
    last = drawn.signals[LAST_OUTCOME.name]
    np.testing.assert_array_equal(last[:, 0], 0.0)
    np.testing.assert_array_equal(last[:, 1:], np.where(drawn.detected, 1.0, -1.0))
