"""Rollouts in tensors on a torch device agree with numpy's."""

import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import ConfigError
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.gap_network import GapNetwork
from pemviz.proposals.offset_logistic import (
    OffsetLogisticProposal,
    PolynomialBasis,
    SignalFeatures,
)
from pemviz.runs.back_ends import batch_rollouts
from pemviz.runs.engine import run_experiment
from pemviz.runs.experiment import build_experiment, device_notes
from pemviz.sampling.problem import sample
from pemviz.sampling.rollouts.devices import (
    DeviceRunner,
    check_device,
    has_tensors,
    missing_cuda,
    simulate_on_device,
)
from pemviz.sampling.rollouts.draw import simulate
from pemviz.sampling.rollouts.final_batch import LARGEST_PART
from pemviz.sampling.value_twisted.method import with_latch
from pemviz.simulators.braking.features import BrakingFeatures
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.latched import LatchedSimulator
from pemviz.types import StateBatch
from tests.simulators.strategies import scenarios
from tests.toy import ConstantPem, MissCounter

PAPER = ExperimentConfig(spec="always[0,59] (gap >= 3.0 or ego_speed < 1.0)")
SCENARIO = replace(PAPER.scenario, states=60)
LOGIT_ERROR = 1e-12
SHORT = {"scenario": replace(PAPER.scenario, states=40), "spec": "always[0,39] (gap >= 9.0)"}


@pytest.fixture(params=["torch-cpu", "cuda"])
def device(request):
    """Both devices; the GPU only where there is one."""
    if request.param == "cuda" and missing_cuda():
        pytest.skip(missing_cuda())
    return request.param


@dataclass(frozen=True)
class HalfTheLogit:
    """A proposal that is not said to compute with tensors; it looks at what it is given."""

    def logit(self, states, pem_logit):
        assert states.signals["gap"].shape == pem_logit.shape
        return 0.5 * pem_logit + 0.01 * states.step

    def arrays(self) -> Mapping[str, np.ndarray]:
        return {}


def gap_network(seed: int) -> GapNetwork:
    generator = np.random.default_rng(seed)
    shapes = ((32, 1), (32, 32), (2, 32))
    return GapNetwork(
        weights=tuple(generator.normal(size=shape) / 4 for shape in shapes),
        biases=tuple(generator.normal(size=shape[0]) for shape in shapes),
    )


def offset_logistic(seed: int, config: ScenarioConfig) -> OffsetLogisticProposal:
    basis = PolynomialBasis(np.array([9.0, 2.0, 2.0]), np.array([3.0, 2.0, 1.5]), degree=3)
    return OffsetLogisticProposal(
        features=BrakingFeatures(config),
        basis=basis,
        coefficients=np.random.default_rng(seed).normal(size=len(basis.exponents)),
        violated="violated",
        defensive=0.02,
    )


PROPOSALS = {
    "pem": PemProposal(),
    "constant": ConstantProposal(0.4),
    "network": gap_network(3),
    "offset": offset_logistic(0, SCENARIO),
    "any signals": replace(
        offset_logistic(0, SCENARIO),
        features=SignalFeatures(VectorizedSimulator(SCENARIO).signals),
        basis=PolynomialBasis(np.array([9.0, 18.0, 17.0, 30.0]), np.full(4, 6.0), degree=2),
        coefficients=np.random.default_rng(5).normal(size=15) / 4,
    ),
    "through numpy": HalfTheLogit(),
}


def check_alike(ours, theirs):
    """Same outcomes and states; logits to rounding."""
    np.testing.assert_array_equal(ours.detected, theirs.detected)
    for name in theirs.signals:
        np.testing.assert_allclose(ours.signals[name], theirs.signals[name], rtol=0, atol=1e-12)
    for name in theirs.memory:
        assert ours.memory[name].dtype == theirs.memory[name].dtype
        np.testing.assert_allclose(
            ours.memory[name].astype(float), theirs.memory[name].astype(float), rtol=0, atol=1e-12
        )
    for logit in ("pem_logit", "proposal_logit"):
        np.testing.assert_allclose(
            getattr(ours, logit), getattr(theirs, logit), rtol=LOGIT_ERROR, atol=LOGIT_ERROR
        )


@pytest.mark.parametrize("pem", ["ml-nn", "lr", "gb-raw", "ml-nn-ensemble"])
@pytest.mark.parametrize("latched", [False, True])
@pytest.mark.parametrize("proposal", PROPOSALS.values(), ids=PROPOSALS)
def test_rollouts_agree_with_numpy(device, proposal, latched, pem):
    problem = build_experiment(replace(PAPER, scenario=SCENARIO, pem=pem)).problem
    simulator = with_latch(problem).simulator if latched else problem.simulator
    parts = {
        "simulator": simulator,
        "pem": problem.pem,
        "proposal": proposal,
        "uniforms": np.random.default_rng(1).random((300, 59)) ** 3,  # many misses
    }
    ours = simulate_on_device(**parts, device=device)
    theirs = simulate(**parts)
    check_alike(ours, theirs)
    assert 0.0 < theirs.detected.mean() < 1.0
    if latched and isinstance(proposal, ConstantProposal):
        assert 0.0 < theirs.memory["violated"][:, -1].mean() < 1.0


@given(scenarios, st.integers(0, 2**32))
@settings(max_examples=25)
def test_dynamics_agree_to_the_last_bit(config, seed):
    """Elementary operations round alike everywhere, so given outcomes give the same states."""
    simulator = VectorizedSimulator(config)
    parts = {
        "simulator": simulator,
        "pem": ConstantPem(miss_probability=0.5),
        "proposal": PemProposal(),
        "uniforms": np.random.default_rng(seed).random((8, config.states - 1)),
    }
    ours, theirs = simulate_on_device(**parts, device="torch-cpu"), simulate(**parts)
    for name in theirs.signals:
        np.testing.assert_array_equal(ours.signals[name], theirs.signals[name])
    for name in theirs.memory:
        np.testing.assert_array_equal(ours.memory[name], theirs.memory[name])


@pytest.fixture(scope="module")
def latched():
    return with_latch(build_experiment(replace(PAPER, scenario=SCENARIO)).problem)


@given(st.integers(4, 50), st.sampled_from(sorted(PROPOSALS)), st.integers(0, 2**32))
@settings(max_examples=12)
def test_any_batch_size_gives_the_same(latched, batch, proposal, seed):
    def drawn(**options):
        return sample(
            replace(latched, **options),
            proposal=PROPOSALS[proposal], count=48, seeds=np.random.SeedSequence(seed),
        )  # fmt: skip

    numpy, torch = drawn(), drawn(batch_rollouts=batch, run_batches=DeviceRunner("torch-cpu"))
    check_alike(torch.rollouts, numpy.rollouts)
    np.testing.assert_allclose(
        torch.rollouts.log_weight, numpy.rollouts.log_weight, rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize(
    ("method", "budget"),
    [
        ("monte-carlo", {"final_rollouts": 300, "spec": "always[0,99] (gap >= 9.6)"}),
        ("naive", {"final_rollouts": 300}),
        ("adaptive", {"stages": 2, "epochs": 100}),
        ("mixture", {"stages": 4}),
        ("value-twisted", {"final_rollouts": 300, **SHORT}),
    ],
)
def test_estimates_agree(device, method, budget):
    config = ExperimentConfig(method=method, seed=3, **budget)
    ours, theirs = run_experiment(replace(config, device=device)), run_experiment(config)
    assert ours.status == theirs.status == "done"
    allowed = 1e-9 if device == "torch-cpu" else 1e-6
    for name in ("probability", "ci_low", "ci_high", "ess", "nll_mean"):
        expected = getattr(theirs.estimate, name)
        if expected is None:
            assert getattr(ours.estimate, name) is None
        else:
            assert getattr(ours.estimate, name) == pytest.approx(expected, rel=allowed, abs=0)
    assert ours.estimate.failures == theirs.estimate.failures


def test_a_simulator_that_cannot_go_there_is_stepped_by_numpy(device, toy_problem):
    parts = {
        "simulator": toy_problem.simulator,
        "pem": toy_problem.pem,
        "proposal": PemProposal(),
        "uniforms": np.random.default_rng(0).random((50, 6)),
    }
    ours, theirs = simulate_on_device(**parts, device=device), simulate(**parts)
    np.testing.assert_array_equal(ours.signals["gap"], theirs.signals["gap"])


STEPS_TAKEN_ON = []


@dataclass(frozen=True)
class CountedMisses(MissCounter):
    """A simulator of the user's own that says that it computes with tensors as well."""

    def step(self, states, detected):
        STEPS_TAKEN_ON.append((int(states.step), type(detected).__module__))
        gap = states.signals["gap"] - (~detected) * 1.0
        return StateBatch(step=states.step + 1, signals={"gap": gap})

    def moved(self, move):
        return self


def test_a_simulator_of_ones_own_computes_with_tensors(device):
    STEPS_TAKEN_ON.clear()
    parts = {
        "simulator": CountedMisses(states=7),
        "pem": ConstantPem(miss_probability=0.3),
        "proposal": PemProposal(),
        "uniforms": np.random.default_rng(0).random((50, 6)),
    }
    ours = simulate_on_device(**parts, device=device)
    assert [(step, "torch") for step in range(6)] == STEPS_TAKEN_ON
    check_alike(ours, simulate(**parts))


def test_a_rule_of_ones_own_is_asked_through_numpy(device):
    def close(states):
        assert isinstance(states.signals["gap"], np.ndarray)
        return states.signals["gap"] < 7.0

    parts = {
        "simulator": LatchedSimulator(VectorizedSimulator(SCENARIO), unsafe=close),
        "pem": build_experiment(replace(PAPER, scenario=SCENARIO)).problem.pem,
        "proposal": offset_logistic(0, SCENARIO),
        "uniforms": np.random.default_rng(1).random((300, 59)) ** 3,
    }
    ours, theirs = simulate_on_device(**parts, device=device), simulate(**parts)
    check_alike(ours, theirs)
    assert 0.0 < theirs.memory["violated"].mean() < 1.0


def test_what_cannot_go_to_a_device_says_so():
    assert has_tensors(VectorizedSimulator(SCENARIO))
    assert has_tensors(LatchedSimulator(VectorizedSimulator(SCENARIO), unsafe=bool))
    assert not has_tensors(LatchedSimulator(MissCounter(states=7), unsafe=bool))
    assert not has_tensors(HalfTheLogit())
    blind = replace(offset_logistic(0, SCENARIO), features=HalfTheLogit())
    assert not has_tensors(blind)


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:-1", "CUDA", "", "cuda:0 ", "torch"])
def test_unknown_devices_are_refused(name):
    with pytest.raises(ConfigError) as caught:
        ExperimentConfig(device=name).validate()
    assert str(caught.value) == f"device = {name!r}: must be cpu, torch-cpu, cuda or cuda:N"


def test_a_gpu_that_is_not_there_is_one_line():
    for name in ("cuda", "cuda:0", "cuda:999"):
        ExperimentConfig(device=name).validate()  # a run folder from elsewhere can be read
    missing = "cuda:999" if not missing_cuda() else "cuda"
    with pytest.raises(ConfigError) as caught:
        build_experiment(ExperimentConfig(device=missing))
    assert str(caught.value).startswith(f"device = '{missing}': torch ")
    assert "\n" not in str(caught.value)
    check_device("torch-cpu")


def test_what_stays_on_the_cpu_is_told():
    def told(**changes):
        config = ExperimentConfig(device="torch-cpu", **changes)
        return device_notes(build_experiment(config))

    stays = "computes on the CPU all the same"
    assert told() == ()
    assert device_notes(build_experiment(ExperimentConfig(pem="gb-raw"))) == ()
    name = build_experiment(ExperimentConfig(pem="gb-raw")).pem.name
    assert told(pem="gb-raw") == (f"device torch-cpu: error model {name} {stays}",)
    assert told(method="splitting") == (f"device torch-cpu: splitting {stays}",)
    assert told(method="value-twisted") == (f"device torch-cpu: value-twisted's proposal {stays}",)
    assert told(simulator="highway-env", pem="gb-raw") == (
        f"device torch-cpu: simulator highway-env {stays}",
    )


def test_gpu_batches_are_large_but_bounded():
    def batch(**changes):
        config = ExperimentConfig(**changes)
        return batch_rollouts(config), batch_rollouts(replace(config, device="cuda:1"))

    assert batch() == (4096, LARGEST_PART)
    assert batch(scenario=replace(PAPER.scenario, states=50_000)) == (40, 40)
    assert batch(simulator="highway-env") == (50, 50)


def test_numpy_runs_without_torch():
    code = """
import sys
from pemviz.config import ExperimentConfig
from pemviz.runs.engine import run_experiment
run_experiment(ExperimentConfig(method="naive", final_rollouts=20))
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
