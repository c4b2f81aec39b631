"""The loop draws from fitted proposals what numpy draws: signals and outcomes to the last bit."""

import hashlib
import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz import compiling
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.gap_network_fit import initial_gap_network
from pemviz.proposals.offset_logistic import (
    LARGEST_SHIFT,
    STANDARD_RANGE,
    OffsetLogisticProposal,
    PolynomialBasis,
)
from pemviz.proposals.pilots import CEILING_LOGIT, PilotFamily
from pemviz.runs import specification
from pemviz.runs.engine import run_experiment
from pemviz.runs.experiment import build_experiment
from pemviz.runs.resume import carry_out
from pemviz.sampling.fitted import drawing, numbers
from pemviz.sampling.fitted.terms import is_served
from pemviz.sampling.memory import proposal_features
from pemviz.sampling.mixture.aims import Aims
from pemviz.sampling.mixture.draws import components, divided
from pemviz.sampling.problem import sample
from pemviz.sampling.rollouts.batches import by_numpy
from pemviz.sampling.rollouts.compiled import CompiledRunner
from pemviz.sampling.rollouts.draw import of_rows, simulate
from pemviz.sampling.value_twisted.method import with_latch
from pemviz.simulators.braking import loops as scenario_loops
from pemviz.simulators.latched import VIOLATED
from tests.faults.test_resume import StopAfter, contents, folder_of

SOURCE = Path(drawing.__file__).with_name("loops.py")
SCENARIOS = st.builds(
    ScenarioConfig,
    initial_speed_kmh=st.floats(20.0, 144.0),
    initial_gap_m=st.floats(5.0, 60.0),
    lead_deceleration_mps2=st.floats(0.0, 12.0),
    lead_brake_time_s=st.floats(0.0, 1.0),
    emergency_gap_m=st.floats(5.0, 60.0),
    maximum_acceleration_mps2=st.floats(0.0, 5.0),
    dt_s=st.floats(0.02, 0.3),
    states=st.integers(2, 12),
    tracker=st.sampled_from(["none", "1/1", "2/3", "3/5,coast=0.2", "2/2,coast=0.1"]),
)
SPECS = ["always[0,{0}] (gap >= 2.0)", "always[1,{0}] (gap > 9.0 and ego_speed <= 12.0)"]
STANDING = "always[0,{0}] (gap >= 2.0 and ego_speed > 0)"  # a car that stands has speed exactly 0


@pytest.fixture(scope="module")
def written_out():
    """The loop as it is written, in Python's own numbers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiling, "is_installed", lambda: False)
        spec = importlib.util.spec_from_file_location("loops_written_out", SOURCE)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return module


def compiled_loop():
    pytest.importorskip("numba")
    found = drawing.compiled_draw()
    assert found is not None
    return found


def problem_of(scenario, *, memory_s=0.0, pem="ml-nn", spec=SPECS[0], latched=True):
    config = ExperimentConfig(
        scenario=scenario, memory_s=memory_s, pem=pem, spec=spec.format(scenario.states - 1)
    )
    experiment = build_experiment(config)
    problem = experiment.problem
    return with_latch(problem) if latched else problem, proposal_features(experiment.features)


def divided_proposal(problem, features, *, count, generator, fits=True):
    """Pilots and two fits with large coefficients, as a stage of mixture draws from them."""
    steps = problem.simulator.states - 1
    states = problem.simulator.initial(count=1)
    width = features.values(states).shape[-1]
    basis = PolynomialBasis(
        mean=generator.normal(5.0, 5.0, width), spread=generator.uniform(1.0, 20.0, width), degree=3
    )
    size = len(basis.exponents)
    like = OffsetLogisticProposal(features, basis, np.zeros(size), VIOLATED, 0.02)
    component = components(count, first=1, shares=[0.5, 0.5] if fits else [], explores=True)
    return divided(
        component,
        {index: generator.normal(0.0, 1.0, size) for index in (1, 2)},
        like if fits else None,
        aims=Aims.of((), [None] * count),
        family=PilotFamily.over(steps),
        features=features,
        generator=generator,
    )


def gap_network(seed, *, scale=1.0):
    network = initial_gap_network(seed=seed)
    return replace(network, weights=tuple(scale * weight for weight in network.weights))


def assert_agrees(problem, proposal, uniforms, loops):
    simulator, pem = problem.simulator, problem.pem
    assert is_served(simulator, pem, proposal)
    found = drawing.drawn(simulator, pem, proposal, uniforms, loops)
    expected = simulate(simulator=simulator, pem=pem, proposal=proposal, uniforms=uniforms)
    assert_same(found, expected)
    return found


def assert_same(found, expected):
    for part in ("signals", "memory"):
        one, other = getattr(found, part), getattr(expected, part)
        assert list(one) == list(other)
        for name, values in other.items():
            np.testing.assert_array_equal(one[name], values, err_msg=name)
            assert one[name].dtype == values.dtype
            assert one[name].T.flags.c_contiguous
    np.testing.assert_array_equal(found.detected, expected.detected)
    for name in ("pem_logit", "proposal_logit"):
        one, other = getattr(found, name), getattr(expected, name)
        assert (np.abs(one - other) <= 1e-12 * np.maximum(1.0, np.abs(other))).all(), name


@settings(max_examples=15, deadline=None)
@given(
    scenario=SCENARIOS,
    memory_s=st.sampled_from([0.0, 0.05, 0.5]),
    pem=st.sampled_from(["ml-nn", "lr"]),
    spec=st.sampled_from(SPECS),
    seed=st.integers(0, 2**31),
)
def test_random_scenarios_written_out(written_out, scenario, memory_s, pem, spec, seed):
    generator = np.random.default_rng(seed)
    problem, features = problem_of(scenario, memory_s=memory_s, pem=pem, spec=spec)
    uniforms = generator.random((12, scenario.states - 1))
    proposal = divided_proposal(problem, features, count=12, generator=generator)
    assert_agrees(problem, proposal, uniforms, written_out)
    assert_agrees(problem, gap_network(seed, scale=3.0), uniforms, written_out)


def test_a_car_that_stands_violates_that_it_moves(written_out):
    """Its speed is exactly 0, and the comparison strict."""
    problem, features = problem_of(ScenarioConfig(), spec=STANDING)
    generator = np.random.default_rng(3)
    proposal = divided_proposal(problem, features, count=400, generator=generator)
    found = assert_agrees(problem, proposal, generator.random((400, 99)), written_out)
    at_zero = (found.signals["ego_speed"] == 0.0).any(axis=1)
    violated = (found.signals["gap"] < 2.0).any(axis=1) | at_zero
    assert 0 < at_zero.sum() < 400
    np.testing.assert_array_equal(found.memory[VIOLATED][:, -1], violated)


def test_pilots_the_model_and_a_constant_alone(written_out):
    generator = np.random.default_rng(2)
    problem, features = problem_of(ScenarioConfig(states=40), memory_s=0.25)
    uniforms = generator.random((40, 39))
    pilots = divided_proposal(problem, features, count=40, generator=generator, fits=False)
    assert_agrees(problem, pilots, uniforms, written_out)
    assert_agrees(problem, ConstantProposal(0.3), uniforms, written_out)
    found = assert_agrees(problem, PemProposal(), uniforms, written_out)
    assert found.proposal_logit is found.pem_logit


def test_draws_too_close_to_call_are_numpys(written_out, monkeypatch):
    """Draws at numpy's own probability of a miss, and next to it: rounding may not decide."""
    problem, _ = problem_of(ScenarioConfig(states=30, initial_gap_m=20.0), latched=False)
    network, uniforms = gap_network(5, scale=2.0), np.random.default_rng(5).random((30, 29))
    drawn = simulate(simulator=problem.simulator, pem=problem.pem, proposal=network,
                     uniforms=uniforms)  # fmt: skip
    rows = np.arange(29)
    miss = 1.0 / (1.0 + np.exp(drawn.proposal_logit[rows, rows]))
    for close in (0.0, 1e-16, -1e-16, 1e-13):
        uniforms[rows, rows] = miss + close
        assert_agrees(problem, network, uniforms, written_out)
    asked = []
    monkeypatch.setattr(
        drawing, "simulate", lambda **given: asked.append(given) or simulate(**given)
    )
    drawing.drawn(problem.simulator, problem.pem, network, uniforms, written_out)
    assert len(asked) == 29
    assert all(given["uniforms"].shape == (1, 29) for given in asked)


def test_logits_that_are_too_large_are_numpys(written_out, monkeypatch):
    problem, _ = problem_of(ScenarioConfig(states=10), latched=False)
    asked = []
    monkeypatch.setattr(
        drawing, "simulate", lambda **given: asked.append(given) or simulate(**given)
    )
    uniforms = np.random.default_rng(1).random((3, 9))
    assert_agrees(problem, gap_network(5, scale=30.0), uniforms, written_out)
    assert len(asked) == 3


@pytest.mark.slow
@pytest.mark.parametrize("memory_s", [0.0, 0.3])
@pytest.mark.parametrize("tracker", ["none", "2/3", "3/5,coast=0.2"])
@pytest.mark.parametrize("speed", [30.0, 50.0, 90.0])
def test_many_rollouts_by_the_compiled_loop(memory_s, tracker, speed):
    generator, loops = np.random.default_rng(int(speed)), compiled_loop()
    scenario = ScenarioConfig(initial_speed_kmh=speed, tracker=tracker)
    problem, features = problem_of(scenario, memory_s=memory_s)
    uniforms = generator.random((700, 99))
    proposal = divided_proposal(problem, features, count=700, generator=generator)
    found = assert_agrees(problem, proposal, uniforms, loops)
    assert found.memory[VIOLATED].any()
    assert_agrees(problem, gap_network(int(speed)), uniforms, loops)
    if memory_s or tracker != "none":
        assert_agrees(problem, PemProposal(), uniforms, loops)
    parts = [slice(0, 1), slice(1, 130), slice(130, 700)]
    for rows in parts:  # a rollout does not depend on the others
        one = drawing.drawn(problem.simulator, problem.pem, of_rows(proposal, rows),
                           uniforms[rows], loops)  # fmt: skip
        np.testing.assert_array_equal(one.proposal_logit, found.proposal_logit[rows])
        np.testing.assert_array_equal(one.pem_logit, found.pem_logit[rows])


def test_what_the_loop_does_not_know_is_numpys():
    network = gap_network(1)
    problem, features = problem_of(ScenarioConfig())
    assert is_served(problem.simulator, problem.pem, network)
    for pem in ("ml-nn-ensemble", "gb-raw"):
        other, _ = problem_of(ScenarioConfig(), pem=pem)
        assert not is_served(other.simulator, other.pem, network)
    filtered, _ = problem_of(ScenarioConfig(tracker="2/3,filter=kalman"))
    until, _ = problem_of(ScenarioConfig(), spec="(gap >= 2.0) until[0,{0}] (ego_speed <= 1.0)")
    either, _ = problem_of(ScenarioConfig(), spec="always[0,{0}] (gap >= 2.0 or ego_speed <= 1.0)")
    for other in (filtered, until, either):
        assert not is_served(other.simulator, other.pem, network)
    for proposal in (PemProposal(), ConstantProposal(0.0), ConstantProposal(1.0)):
        assert not is_served(problem.simulator, problem.pem, proposal)
    remembering, seen = problem_of(ScenarioConfig(), memory_s=0.2)
    generator = np.random.default_rng(0)
    blind = divided_proposal(problem, features, count=20, generator=generator)
    assert is_served(problem.simulator, problem.pem, blind)
    assert not is_served(remembering.simulator, remembering.pem, blind)
    knowing = divided_proposal(remembering, seen, count=20, generator=generator)
    assert is_served(remembering.simulator, remembering.pem, knowing)
    assert not is_served(remembering.simulator, problem.pem, knowing)


def test_only_a_final_batch_in_parts_goes_through_the_loop(monkeypatch):
    """By the settings alone: whatever else a process has drawn."""
    drawn = []

    def simulated(simulator, pem, task):
        drawn.extend([task.uniforms.shape] * task.many)
        return by_numpy(simulator, pem, task)

    monkeypatch.setattr(specification, "simulated", simulated)
    for method in ("mixture", "adaptive"):
        config = ExperimentConfig(
            method=method, stages=1, rollouts=60, final_rollouts=90,
            scenario=ScenarioConfig(states=30), spec="always[0,29] (gap >= 6.0)",
        )  # fmt: skip
        experiment = build_experiment(config)
        run_experiment(config)
        assert not drawn
        chosen = replace(experiment.method, largest_part=40)
        state = chosen.init(experiment.problem, repetition=0)
        while not chosen.is_done(state):
            state, _ = chosen.step(experiment.problem, state)
        assert drawn == [(30, 29)] * 3
        drawn.clear()


@pytest.mark.slow
def test_a_stopped_run_goes_on_to_the_same_bytes(tmp_path):
    """Parts drawn by the loop before, and in another process's place after."""
    compiled_loop()
    config = ExperimentConfig(
        method="mixture", stages=1, rollouts=60, final_rollouts=120, memory_s=0.1,
        scenario=ScenarioConfig(states=40), spec="always[0,39] (gap >= 6.0)",
    )  # fmt: skip
    experiment = build_experiment(config)
    parts = replace(experiment, method=replace(experiment.method, largest_part=40))
    whole, stopped = folder_of(tmp_path, "whole"), folder_of(tmp_path, "stopped")
    carry_out(parts, whole)
    stop = StopAfter(4)
    assert carry_out(parts, stopped, observers=[stop], should_stop=stop).status == "stopped"
    carry_out(parts, stopped)
    assert contents(stopped) == contents(whole)


@pytest.mark.slow
def test_a_stage_of_many_is_the_same_in_any_batches():
    compiled_loop()
    problem, _ = problem_of(ScenarioConfig(), latched=False)
    runner = CompiledRunner(simulated=drawing.simulated)
    one, other = (
        sample(replace(problem, batch_rollouts=size, run_batches=runner), count=600, many=True,
               proposal=gap_network(3), seeds=np.random.SeedSequence(4)).rollouts
        for size in (600, 77)
    )  # fmt: skip
    np.testing.assert_array_equal(one.proposal_logit, other.proposal_logit)
    exact = sample(problem, proposal=gap_network(3), count=600, seeds=np.random.SeedSequence(4))
    assert_same(one, exact.rollouts)


def test_what_is_compiled_is_of_todays_files():
    """What numba keeps follows the loop's own file alone; of others it says what they were."""
    files = [Path(module.__file__).read_bytes() for module in (scenario_loops, numbers)]
    limits = f"{LARGEST_SHIFT} {STANDARD_RANGE} {CEILING_LOGIT}".encode()
    used = hashlib.sha256(b"".join([*files, limits])).hexdigest()[:16]
    assert f'USED_AS_OF = "{used}"' in SOURCE.read_text(encoding="utf-8")
