"""The compiled loop simulates what numpy simulates, to the last bit."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz import compiling
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.pem import as_pem, load_pem
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.problem import sample
from pemviz.sampling.rollouts import compiled, compiled_replay
from pemviz.sampling.rollouts.batches import BatchTask, run_here
from pemviz.sampling.rollouts.compiled import CompiledRollouts, CompiledRunner, is_served
from pemviz.sampling.rollouts.draw import replay, simulate
from pemviz.sampling.rollouts.kernels import Loops, compiled_loops
from pemviz.simulators.braking.vectorized import VectorizedSimulator

PEM = load_pem("ml-nn")
SCENARIOS = st.builds(
    ScenarioConfig,
    initial_speed_kmh=st.floats(1.0, 144.0),
    initial_gap_m=st.floats(1.0, 60.0),
    lead_deceleration_mps2=st.floats(0.0, 20.0),
    lead_brake_time_s=st.floats(0.0, 1.0),
    emergency_gap_m=st.floats(1.0, 60.0),
    speed_gain_per_s=st.floats(0.0, 5.0),
    speed_integral_gain_per_s2=st.floats(0.0, 2.0),
    maximum_acceleration_mps2=st.floats(0.0, 5.0),
    maximum_deceleration_mps2=st.floats(0.0, 5.0),
    dt_s=st.floats(0.01, 0.3),
    states=st.integers(2, 14),
)


@pytest.fixture(params=["as written", "compiled"])
def loops(request):
    """The loops; Python's own numbers wrap around as the compiled ones do, but warn."""
    if request.param == "as written":
        with np.errstate(over="ignore"):
            yield Loops()
        return
    pytest.importorskip("numba")
    found = compiled_loops()
    assert found is not None
    yield found


def assert_same(found, expected):
    for part in ("signals", "memory"):
        one, other = getattr(found, part), getattr(expected, part)
        assert list(one) == list(other)
        for name, values in other.items():
            np.testing.assert_array_equal(one[name], values, err_msg=name)
            assert one[name].T.flags.c_contiguous
    for name in ("detected", "pem_logit", "proposal_logit"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert found.latents is expected.latents is None


def both(simulator, rollouts, uniforms):
    expected = simulate(
        simulator=simulator, pem=rollouts.pem, proposal=PemProposal(), uniforms=uniforms
    )
    assert_same(rollouts.simulate(uniforms), expected)


@settings(max_examples=25, deadline=None)
@given(config=SCENARIOS, seed=st.integers(0, 2**31))
def test_random_scenarios_written_out(config, seed):
    simulator, generator = VectorizedSimulator(config), np.random.default_rng(seed)
    rollouts = CompiledRollouts(simulator, PEM, Loops())
    uniforms = generator.random((6, config.states - 1))
    with np.errstate(over="ignore"):
        both(simulator, rollouts, uniforms)  # nothing is known: all by numpy
        both(simulator, rollouts, uniforms)  # all is known: all by the loop
        both(simulator, rollouts, generator.random((6, config.states - 1)))  # some


@pytest.mark.parametrize("pem", ["ml-nn", "gb-raw", "ml-nn-ensemble"])
def test_shipped_models_and_tables_that_grow(loops, pem, monkeypatch):
    simulator, generator = VectorizedSimulator(ScenarioConfig(states=20)), np.random.default_rng(3)
    monkeypatch.setattr(compiled, "FEWEST_PLACES", 4)
    rollouts = CompiledRollouts(simulator, load_pem(pem), loops)
    for count in (3, 70, 1, 200):
        both(simulator, rollouts, generator.random((count, 19)))


def test_a_full_table_is_begun_anew(loops, monkeypatch):
    simulator, generator = VectorizedSimulator(ScenarioConfig(states=30)), np.random.default_rng(4)
    monkeypatch.setattr(compiled, "FEWEST_PLACES", 64)
    monkeypatch.setattr(compiled, "MOST_PLACES", 256)
    rollouts = CompiledRollouts(simulator, PEM, loops)
    for _ in range(4):
        both(simulator, rollouts, generator.random((40, 29)))


def test_every_config_and_number_of_the_scenario_is_told(loops):
    """town01 has another speed, deceleration and limit; the lead car may brake late."""
    config = ScenarioConfig(
        initial_speed_kmh=30.0, lead_deceleration_mps2=8.0, maximum_acceleration_mps2=2.0,
        lead_brake_time_s=0.7, emergency_deceleration_mps2=6.0, states=40,
    )  # fmt: skip
    simulator, generator = VectorizedSimulator(config), np.random.default_rng(5)
    rollouts = CompiledRollouts(simulator, PEM, loops)
    for _ in range(2):
        both(simulator, rollouts, generator.random((50, 39)))


@settings(max_examples=25, deadline=None)
@given(config=SCENARIOS, seed=st.integers(0, 2**31), count=st.sampled_from([0, 1, 7]))
def test_replay_of_random_outcomes_in_random_scenarios_written_out(config, seed, count):
    assert_replayed(config, count, Loops(), np.random.default_rng(seed))


@pytest.mark.parametrize("count", [1, 1023, 1024, 1025, 2300])
def test_compiled_replay_of_more_than_are_taken_together(count):
    pytest.importorskip("numba")
    found = compiled_loops()
    assert found is not None
    for config in (ScenarioConfig(), ScenarioConfig(lead_brake_time_s=0.7, states=37)):
        assert_replayed(config, count, found, np.random.default_rng(count))


def assert_replayed(config, count, loops, generator):
    simulator = VectorizedSimulator(config)
    detected = generator.random((count, config.states - 1)) < generator.random()
    states, expected = simulator.initial(count=count), []
    for outcomes in [*detected.T, None]:
        expected.append(states.signals)
        states = states if outcomes is None else simulator.step(states, outcomes)
    found = compiled_replay.replay(simulator, detected, loops)
    for name in expected[0]:
        assert found[name].T.flags.c_contiguous
        by_hand = np.stack([signals[name] for signals in expected], axis=1)
        np.testing.assert_array_equal(found[name], by_hand, err_msg=name)


def test_replay_is_compiled_where_the_loop_is_loaded_and_only_of_what_it_knows(monkeypatch):
    told = []
    monkeypatch.setattr(compiled_replay, "compiled_loops", lambda: told.append(1) or Loops())
    monkeypatch.setattr(compiled_replay, "are_loaded", lambda: False)
    monkeypatch.setattr(compiled_replay, "WORTH_LOADING", 31)
    simulator = VectorizedSimulator(ScenarioConfig(states=11))
    tracked = VectorizedSimulator(ScenarioConfig(states=11, tracker="2/3"))
    outcomes = np.random.default_rng(9).random((4, 10)) < 0.5
    few, many = replay(simulator=simulator, detected=outcomes[:3]), len(told)
    assert not many
    all_of_them = replay(simulator=simulator, detected=outcomes)
    assert told == [1]
    for name, values in few.items():
        np.testing.assert_array_equal(values, all_of_them[name][:3], err_msg=name)
    monkeypatch.setattr(compiled_replay, "are_loaded", lambda: True)
    replay(simulator=simulator, detected=outcomes[:1])
    assert told == [1, 1]
    replay(simulator=tracked, detected=outcomes)
    assert told == [1, 1]


SIMULATOR = VectorizedSimulator(ScenarioConfig())


@pytest.mark.parametrize(
    ("simulator", "pem", "proposal"),
    [
        (VectorizedSimulator(ScenarioConfig(tracker="2/3")), PEM, PemProposal()),
        (SIMULATOR, as_pem(SimpleNamespace(logit=PEM.logit)), PemProposal()),
        (SIMULATOR, PEM, ConstantProposal(0.5)),
        (build_experiment(ExperimentConfig(memory_s=0.2)).problem.simulator, PEM, PemProposal()),
    ],
)
def test_what_the_loop_does_not_know_numpy_simulates(simulator, pem, proposal):
    assert is_served(SIMULATOR, PEM, PemProposal())
    assert not is_served(simulator, pem, proposal)


@pytest.mark.parametrize("broken", ["absent", "no cache", "fails"])
def test_without_a_numba_that_works_numpy_simulates(broken, monkeypatch, caplog):
    def njit(function=None, *, cache=False):
        if broken == "fails":
            raise ImportError("Numba needs NumPy 1.26 or less")
        if cache:
            raise RuntimeError("cannot cache function")
        return function

    monkeypatch.setattr(compiling, "is_installed", lambda: broken != "absent")
    monkeypatch.setitem(sys.modules, "numba", SimpleNamespace(njit=njit))
    compiled_loops.cache_clear()
    try:
        found = compiled_loops()
        uniforms = np.random.default_rng(6).random((2, 99))
        with np.errstate(over="ignore"):
            batches = list(CompiledRunner(0)(SIMULATOR, PEM, [BatchTask(PemProposal(), uniforms)]))
    finally:
        compiled_loops.cache_clear()
    assert (found is None) == (broken != "no cache")
    assert ("numpy computes" in caplog.text) == (broken == "fails")
    expected = next(run_here(SIMULATOR, PEM, [BatchTask(PemProposal(), uniforms)]))
    assert_same(batches[0], expected)


def test_a_stage_does_not_depend_on_the_loop_or_its_batches():
    pytest.importorskip("numba")
    problem = build_experiment(ExperimentConfig(method="monte-carlo")).problem
    by_numpy, by_loop = (
        sample(
            replace(problem, run_batches=runner, batch_rollouts=size),
            proposal=PemProposal(), count=1500, seeds=np.random.SeedSequence(8),
        )
        for runner, size in ((run_here, 1500), (CompiledRunner(first_by_numpy=400), 350))
    )  # fmt: skip
    assert_same(by_loop.rollouts, by_numpy.rollouts)
    np.testing.assert_array_equal(by_loop.robustness, by_numpy.robustness)
    assert np.unique(by_numpy.robustness).size > 10
