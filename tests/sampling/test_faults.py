"""Simulators that raise, return what is no number, or hang."""

import threading
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.rollouts.batches import SimulationError
from pemviz.sampling.splitting.method import SplittingSampling
from tests.toy import FunctionPem, MissCounter, constant_pem

STATES = 12


@dataclass(frozen=True)
class Faulty(MissCounter):
    """After ``good_steps`` steps, does what ``fault`` does to the gaps."""

    states: int = STATES
    good_steps: int = 5
    fault: object = None

    def step(self, states, detected):
        after = super().step(states, detected)
        if int(after.step) <= self.good_steps:
            return after
        return replace(after, signals={"gap": self.fault(after.signals["gap"])})


def problem_of(fault, **options):
    return Problem(
        simulator=Faulty(fault=fault),
        pem=constant_pem(detection_probability=0.9),
        robustness=lambda signals: signals["gap"].min(axis=1),
        violated=lambda signals: signals["gap"].min(axis=1) < 0.0,
        **options,
    )


def draw(problem, count=10):
    return sample(problem, proposal=PemProposal(), count=count, seeds=np.random.SeedSequence(0))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_no_number_is_told_with_rollout_and_step(value):
    def spoil(gap):
        spoiled = gap.copy()
        spoiled[min(2, gap.size - 1)] = value
        return spoiled

    with pytest.raises(SimulationError) as caught:
        draw(problem_of(spoil, batch_rollouts=4), count=10)
    words = str(caught.value)
    assert "simulator miss-counter: gap is" in words
    assert "rollout 2, step 6" in words


def test_an_error_model_without_a_number_is_told():
    problem = replace(
        problem_of(lambda gap: gap), pem=FunctionPem(lambda x: np.full(x.shape[0], np.nan))
    )
    with pytest.raises(SimulationError, match="error model: logit is nan in rollout 0, step 0"):
        draw(problem)


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e101])
def test_infinite_logits_are_refused(value):
    """They cannot be read back from a kept stage, and differences of them are no number."""
    certain = FunctionPem(lambda x: np.full(x.shape[0], value))
    problem = replace(problem_of(lambda gap: gap), pem=certain)
    with pytest.raises(SimulationError, match=r"error model: logit is .* must be a finite number"):
        draw(problem)


def split(problem):
    method = SplittingSampling(stages=2, rollouts=5, seed=0)
    return method.step(problem, method.init(problem, repetition=0))


@pytest.mark.parametrize("carry_out", [draw, split])
def test_a_simulator_that_hangs_fails_in_time(carry_out):
    released = threading.Event()

    def hang(gap):
        released.wait(60.0)
        return gap

    problem = problem_of(hang, batch_time_limit_s=0.2)
    try:
        with pytest.raises(SimulationError, match=r"longer than batch_time_limit_s = 0\.2"):
            carry_out(problem)
    finally:
        released.set()


def test_what_a_simulator_raises_comes_through():
    def fail(gap):
        raise ZeroDivisionError("wheel fell off")

    with pytest.raises(ZeroDivisionError, match="wheel fell off"):
        draw(problem_of(fail, batch_time_limit_s=5.0))
