"""The failure probability over frailties, against all chains of outcomes."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import expit, ndtr, ndtri

from pemviz.charts.svg import svg
from pemviz.pem.model_files import load_pem
from pemviz.pem.models.memory import Memory
from pemviz.proposals.offset_logistic import SignalFeatures
from pemviz.reports.charts import memory_chart
from pemviz.reports.memory_words import BY_FRAILTY, curve_table, frailty_line
from pemviz.runs.result import RunMemory, own_memory
from pemviz.sampling.bursts.curve import (
    MEASURED_FRAILTY,
    SHOWN_FRAILTY,
    CurvePoint,
    frailty_curve,
    memory_curve,
)
from pemviz.sampling.bursts.reweighting import Outcomes, over_visibility
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_problem_of,
)

PEM = ToyPem(at_zero=2.5)
BLIND = 3


@dataclass(frozen=True, kw_only=True)
class ApproachingWalk(ToySimulator):
    """A walk whose first steps lead nearer whatever is detected."""

    initial_gap: int = 6
    largest_gap: int = 8
    states: int = 11

    def step(self, states, detected):
        return super().step(states, detected & (states.step >= BLIND))


@dataclass(frozen=True)
class Evaluating(SignalFeatures):
    """Where the walk reacts: truly so from step BLIND on."""

    since: int = BLIND

    def reacts(self, states):
        return (states.step >= self.since) & super().reacts(states)


WALK = ApproachingWalk()
CHAINS = np.array(
    [[bool(number >> bit & 1) for bit in range(WALK.states - 1)] for number in range(2**10)]
)
PROBLEM = toy_problem_of(WALK, PEM)


def gaps_of_chains():
    """Gaps before each outcome ``[1024, 10]``, and which chains come to the obstacle."""
    gap, before = np.full(len(CHAINS), float(WALK.initial_gap)), []
    hit = np.zeros(len(CHAINS), dtype=bool)
    for step, detected in enumerate(CHAINS.T):
        before.append(gap)
        away = detected & (step >= BLIND)
        gap = np.where(away, np.minimum(gap + 1, WALK.largest_gap), gap - 1)
        hit |= gap <= 0
    return np.array(before).T, hit


GAPS, HIT = gaps_of_chains()


def chain_probabilities(memory):
    """Of all chains ``[1024]``, by an integral over the obstacle in plain numbers."""
    u = np.arange(-10.0, 10.0, 0.05)
    given_u = np.tile(np.exp(-0.5 * u**2) / np.exp(-0.5 * u**2).sum(), (len(CHAINS), 1))
    rho = math.exp(-WALK.dt_s / memory.tau_s) if memory.tau_s else 0.0
    quantile = ndtri(expit(-PEM.logit(GAPS[..., None]))) * math.sqrt(1.0 + memory.frailty**2)
    for step, detected in enumerate(CHAINS.T):
        miss = ndtr(quantile[:, step, None] + memory.frailty * u)
        if step:
            before = CHAINS[:, step - 1, None]
            miss = miss + (np.where(before, 0.0, 1.0) - miss) * rho
        given_u = given_u * np.where(detected[:, None], 1.0 - miss, miss)
    return given_u.sum(axis=1)


def truth(memory):
    return float(chain_probabilities(memory)[HIT].sum())


def curve_of(problem=PROBLEM, *, since=BLIND, curve=frailty_curve, **options):
    features = Evaluating(WALK.signals, since)
    options = {"rollouts": 1200, **options}
    return curve(problem, pem=PEM, features=features, seed=2, **options)


def assert_holds(points):
    """Twice the 95 % interval's half width: seeds are fixed, a false alarm in 1e4 a point."""
    for point in points:
        exact = truth(Memory(point.tau_s, point.frailty))
        half = math.log(point.high / point.low) / 2
        assert abs(math.log(point.probability / exact)) < 2 * half, point
        assert half < 0.5


@pytest.mark.parametrize("memory", [Memory(0.0, 0.5), Memory(0.0, 3.0), Memory(2.0, 1.0)])
def test_chains_are_as_likely_as_an_integral_over_the_obstacle_says(memory):
    last = np.where(CHAINS, 1.0, -1.0)
    outcomes = Outcomes(
        rollout=np.repeat(np.arange(len(CHAINS)), CHAINS.shape[1]),
        step=np.tile(np.arange(CHAINS.shape[1]), len(CHAINS)),
        basis=np.zeros((CHAINS.size, 0)),
        missed=~CHAINS.ravel(),
        last=np.pad(last[:, :-1], ((0, 0), (1, 0))).ravel(),
        logit=PEM.logit(GAPS.reshape(-1, 1)),
        matters=np.ones(CHAINS.size, dtype=bool),
    )
    log_p, mean = over_visibility(outcomes, memory, dt_s=WALK.dt_s, count=len(CHAINS))
    exact = chain_probabilities(memory)
    np.testing.assert_allclose(np.exp(log_p), exact, rtol=1e-9)
    # what is not missed tells that an obstacle is not hard to see, and the other way round
    assert np.all(np.diff(mean[np.argsort(CHAINS.sum(axis=1))][[0, 512, -1]]) < 0.0)


@pytest.mark.parametrize("tau_s", [0.0, 2.0])
def test_one_set_of_rollouts_serves_every_frailty(tau_s):
    points = curve_of(also=(3.0,), tau_s=tau_s)
    assert [point.frailty for point in points] == [*SHOWN_FRAILTY, 3.0]
    assert {point.tau_s for point in points} == {tau_s}
    assert_holds(points)


def test_one_set_of_rollouts_serves_every_memory_time_of_obstacles_that_differ():
    points = curve_of(curve=memory_curve, also_s=(2.0,), frailty=0.8)
    assert {point.frailty for point in points} == {0.8}
    assert_holds(points)


def test_outcomes_to_which_the_scenario_does_react_after_all_are_kept():
    """The features say that two steps more do not matter, and they decide."""
    assert_holds(curve_of(since=BLIND + 2))


def test_the_curve_does_not_depend_on_the_batch_size():
    batches = replace(PROBLEM, batch_rollouts=17)
    assert curve_of(rollouts=300) == curve_of(batches, rollouts=300)


def test_the_measured_frailties_are_the_shipped_models():
    for name, frailty in MEASURED_FRAILTY.items():
        own = own_memory(load_pem(name.split(",")[0].lower()))
        assert own.memory.frailty == pytest.approx(frailty, abs=0.005)


def test_words_and_picture_say_whose_frailty_it_is_and_what_it_is_worth():
    curve = [CurvePoint(0.0, p, p / 2, 2 * p, 50.0, (), f) for f, p in ((0.0, 1e-15), (0.68, 5e-4))]
    memory = RunMemory(tau_s=0.0, frailty_curve=tuple(curve))
    line = frailty_line(memory)
    assert line.startswith("So is that objects in the same state are equal (frailty 0): 1e-15")
    assert "0.0005 with that of RRC, a camera detector (0.68). " in line
    assert line.endswith("changes the answer by 12 orders of magnitude.")
    assert frailty_line(replace(memory, frailty=0.68)).startswith("So is a frailty of 0.68: 1e-15")
    assert [row[0] for row in curve_table(memory, BY_FRAILTY).rows] == ["all equal", "0.68"]
    assert "0.68: RRC, on video" in svg(memory_chart(memory, BY_FRAILTY))
