"""Violations that are drawn by their weights and moved: where they go, and what comes of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.external.motions import LimitState
from benchmarks.external.problems import chosen, experiment_of
from benchmarks.external.systems import MotionDetector, MotionSimulator
from pemviz.config import ExperimentConfig
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.mixture import resampled, stages
from pemviz.sampling.mixture.explored import (
    IN_NO_WEIGHT,
    fits_to_unknown,
    log_pool_weight,
    pool_under,
)
from pemviz.sampling.mixture.rejuvenated import Rejuvenated
from pemviz.sampling.mixture.resampled import Resampled
from pemviz.sampling.problem import FinishedStage, score
from pemviz.sampling.subset.exploring import Explored
from pemviz.sampling.subset.run import shape_of, simulated_from
from tests.latent_toys import Drift
from tests.toy import ConstantPem, stepped_through

RADIUS = 6.0
PROBABILITY = np.exp(-(RADIUS**2) / 2.0)
BALL = LimitState(function=lambda start: RADIUS**2 - (start**2).sum(axis=1), starts=2)


def around(seed, **settings):
    """Two random numbers at the start, which violate beyond the ball."""
    config = ExperimentConfig(seed=seed, spec=BALL.spec, plan=False, **settings)
    return build_experiment(
        config, simulator=MotionSimulator(BALL, "ball"), pem=MotionDetector(BALL)
    )


def states_of(whole):
    state = whole.method.init(whole.problem, repetition=0)
    while not whole.method.is_done(state):
        state, result = whole.method.step(whole.problem, state)
        yield state, result


def beyond(problem, angle, radius):
    """Violations that begin there."""
    numbers = shape_of(problem).normals(np.random.default_rng(0), angle.size)
    start = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return score(problem, simulated_from(problem, replace(numbers, start=start))[0])


def error_by_truth(problem, method, state):
    """Of the average of weights, relative to the answer, by violations as the model has them."""
    angle = 2.0 * np.pi * (np.arange(960) + 0.5) / 960
    radius = np.sqrt(RADIUS**2 + np.random.default_rng(1).exponential(2.0, angle.size))
    of_truth, pool = beyond(problem, angle, radius), state.pool
    assert of_truth.violated.all()
    own = pool_under(of_truth, pool.proposals, method._terms(state, state.basis))
    moment = np.exp(log_pool_weight(own, pool)).mean()
    return np.sqrt((moment / PROBABILITY - 1.0) / pool.sampled)


def test_no_part_of_what_lies_all_around_is_left_out():
    """The error that violations in all directions tell is about the one that weights tell.

    With nothing moved it is 1.6 times as large, on average.
    """
    factors = list[float]()
    for seed in range(1, 7):
        whole = around(seed)
        state = list(states_of(whole))[-1][0]
        found, proposing = whole.method.estimate(state), state.proposing
        problem = stages.watching(whole.problem)
        error = error_by_truth(problem, proposing.method, proposing.state)
        factors.append(error / (found.std_error / found.probability))
    assert np.mean(factors) < 1.3


@pytest.fixture(scope="module")
def sampled():
    """Its stages, with few chains."""
    whole = around(3, method="mixture", chains=60, rollouts=200, stages=3)
    return whole, list(states_of(whole))


def after(whole, state, scored, pool, *, seed=0, before=None, **changed):
    known = {"tuning": state.explored.tuning, "most": 1e9, "kept": None, **changed}
    return (before or Resampled()).after(
        stages.watching(whole.problem), scored, pool, seeds=np.random.SeedSequence(seed), **known
    )


def test_what_weighs_most_is_moved_most(sampled):
    whole, states = sampled
    state, result = states[1]
    found = after(whole, state, result.scored, state.pool)
    first = state.pool.count - result.count
    assert found.simulated == found.newest == found.ancestor.size == 40
    assert found.scored.violated.all()
    assert state.pool.violated[found.ancestor].all()
    weight = np.where(state.pool.violated, np.exp(state.pool.log_weight), 0.0)[first:]
    times = np.bincount(found.ancestor - first, minlength=weight.size)
    assert (np.abs(times - 40.0 * weight / weight.sum()) < 1.0 + 1e-9).all()
    begun = result.scored.rollouts.latents.start[found.ancestor - first]
    stayed = (found.scored.rollouts.latents.start == begun).all(axis=1)
    np.testing.assert_array_equal(stayed, ~found.moved)
    assert 0.2 < found.moved.mean() < 0.95


def test_few_rollouts_have_few_moved_and_none_where_none_are_left(sampled):
    whole, states = sampled
    state, result = states[1]
    some = result.scored.take(slice(-50, None))
    assert after(whole, state, some, state.pool).simulated == 20
    nothing = after(whole, state, some, state.pool, most=19.0)
    assert (nothing.scored, nothing.simulated, nothing.of_newest) == (None, 0, None)


def test_what_was_moved_stays_and_goes_on(sampled):
    whole, states = sampled
    state, result = states[1]
    once = after(whole, state, result.scored, state.pool)
    again = after(whole, state, result.scored, state.pool, seed=1, before=once, moves=3)
    assert (again.newest, again.simulated) == (3 * 40, 40 + 3 * 40)
    assert again.of_newest.rollouts.count == 40
    assert again.of_newest.violated.all()
    ours, theirs = again.ancestor[40:], once.ancestor
    stayed = sum(min((ours == one).sum(), (theirs == one).sum()) for one in np.unique(theirs))
    assert stayed >= 32
    assert again.moved[40:].mean() > once.moved.mean()
    # without several moves none stays
    other = after(whole, state, result.scored, state.pool, seed=0, before=once)
    np.testing.assert_array_equal(other.ancestor[40:], once.ancestor)
    np.testing.assert_array_equal(other.moved[40:], once.moved)


def test_no_more_moves_are_made_than_are_left(sampled):
    whole, states = sampled
    state, result = states[1]
    assert after(whole, state, result.scored, state.pool, moves=6, most=119.0).simulated == 80
    assert after(whole, state, result.scored, state.pool, moves=6, most=39.0).simulated == 0


@pytest.mark.parametrize("moves", [1, 4])
def test_a_move_keeps_what_the_model_does_where_it_violates(moves):
    """A start beyond 2 of 1: exactly sampled, it is so after the moves, of those that stay too.

    A Kolmogorov-Smirnov test, which fails one time in 10,000.
    """
    drift = Drift(start_sd_m=1.0, noise_sd_m=0.0, states=3)
    config = ExperimentConfig(method="mixture", spec=drift.spec(2.0), plan=False)
    whole = build_experiment(config, simulator=drift, pem=ConstantPem(0.1))
    problem = stages.watching(whole.problem)
    state, _ = next(states_of(whole))
    terms, starts, moved = whole.method._terms(state, state.basis), list[np.ndarray](), 0
    for seed in range(25):
        generator = np.random.default_rng([9, seed])
        numbers = shape_of(problem).normals(generator, 100)
        start = stats.truncnorm(2.0, np.inf).rvs(100, random_state=generator)
        numbers = replace(numbers, start=start[:, None])
        scored = score(problem, simulated_from(problem, numbers)[0])
        pool = pool_under(scored, (state.pool.proposals[0],), terms)
        pool = replace(pool, log_ratio=np.zeros_like(pool.log_ratio))
        found = after(whole, state, scored, pool, seed=seed, tuning=None, moves=moves)
        if moves > 1:
            known = {"before": found, "tuning": None, "moves": moves}
            found = after(whole, state, scored, pool, seed=seed + 25, **known)
        moved += int(found.moved.sum())
        starts.append(found.of_newest.rollouts.latents.start[:, 0])
    drawn = np.concatenate(starts)
    assert (drawn.size, moved > 100) == (25 * 40, True)
    assert stats.kstest(drawn, stats.truncnorm(2.0, np.inf).cdf).pvalue > 1e-4


def test_proposals_for_a_gap_have_no_part_in_the_weight_that_led_there(sampled):
    whole, states = sampled
    method = whole.method
    for state, _ in states[1:-1]:
        terms = method._terms(state, state.basis)
        known = {"terms": terms, "basis": state.basis, "settings": method.settings}
        found = state.resampled
        fits = fits_to_unknown(Rejuvenated(), found, state.pool, **known)
        own = pool_under(found.scored, state.pool.proposals, terms)
        total = np.exp(state.pool.log_weight[state.pool.violated]).sum()
        scarce = np.exp(log_pool_weight(own, state.pool)) > total / 100.0
        led = np.unique(found.ancestor[scarce & found.moved])
        assert bool(fits) == (led.size > 0)
        for fit in fits:
            np.testing.assert_array_equal(np.flatnonzero(fit.optimism == IN_NO_WEIGHT), led)


def test_each_of_several_rules_has_as_many_moved_and_keeps_them():
    """Of two, one is broken a thousand times as often, wherever the other is too."""
    drift = Drift(start_sd_m=1.0, noise_sd_m=0.0, states=3)
    rules = {"near": drift.spec(0.5), "far": drift.spec(3.5)}
    config = ExperimentConfig(method="mixture", chains=30, stages=2, plan=False).with_rules(rules)
    whole = build_experiment(config, simulator=drift, pem=ConstantPem(0.1))
    (before, _), (state, result) = list(states_of(whole))[1:3]
    first = before.pool.count
    newest = result.scored.take(state.pool.row[first:] - before.pool.sampled)
    found = after(whole, state, newest, state.pool)
    each = int(0.4 * newest.rollouts.count) // 2
    assert found.ancestor.size == 2 * each
    assert set(state.pool.rules) == {"near", "far"}
    for rule, rows in zip(state.pool.rules, (slice(each), slice(each, None)), strict=True):
        assert newest.broken[rule][found.ancestor[rows] - first].all()
        assert found.scored.broken[rule][rows].all()
        assert found.moved[rows].any()
    on = after(whole, state, newest, state.pool, before=found, moves=3)
    for rule, rows in zip(state.pool.rules, (slice(each), slice(each, None)), strict=True):
        assert on.of_newest.broken[rule][rows].all()
    far = on.ancestor[2 * each :][each:]
    assert np.isin(far, found.ancestor[found.scored.broken["far"]]).sum() >= int(0.8 * each) // 2


@pytest.mark.parametrize(
    ("found", "poor"),
    [
        ({"log_probability": np.full(3, -np.inf)}, True),
        ({"log_probability": np.zeros(3), "log_weight": np.zeros(7), "independent": 0.2}, True),
        ({"log_probability": np.zeros(3), "log_weight": np.zeros(7), "independent": 0.3}, False),
        ({}, False),  # nothing was searched
    ],
)
def test_chains_find_no_way_where_all_that_they_found_descends_from_one(found, poor):
    assert Explored(**found).is_poor == poor


def test_several_moves_leave_what_stages_are_to_take(sampled):
    """Of 1,000 rollouts that are left, three stages of 200 take 600, a move of each 40."""
    whole, states = sampled
    method = replace(whole.method, learning_stages=4, most_moves=1_000.0)
    lost = replace(states[0][0].explored, independent=0.0)
    none = {"resampled": Resampled(), "rejuvenated": Rejuvenated()}
    state = replace(states[0][0], explored=lost, **none)
    for most, moves in ((1_000.0, 3), (700.0, 1), (100.0, 1), (1e6, 6), (np.inf, 6)):
        assert replace(method, most_moves=most)._moves(state) == moves
    assert method._moves(states[0][0]) == 1


def test_what_is_left_of_a_run_counts_every_move(monkeypatch):
    whole = around(2)
    begun = (
        state for state, _ in states_of(whole) if state.proposing and state.proposing.state.pool
    )
    state, foreseen = next(begun), []
    for poor in (False, True):
        monkeypatch.setattr(Explored, "is_poor", poor)
        foreseen.append(whole.method.foreseen(state).searches)
    assert foreseen[0] > 0
    assert foreseen[1] == resampled.MOVES * foreseen[0]


@pytest.mark.parametrize("poor", [False, True])
def test_an_interrupted_run_moves_nothing_again(poor, monkeypatch):
    monkeypatch.setattr(Explored, "is_poor", poor)
    whole = around(2, method="mixture", chains=60, rollouts=60, stages=3)
    state, results = stepped_through(whole.method, whole.problem)
    left = {
        result.stage: FinishedStage(result.scored, result.kept, result.sampled)
        for result in results[:3]
    }
    assert resampled.SIMULATED in left[2].kept
    problem = replace(whole.problem, finished=lambda _, stage: left.get(stage))
    again, _ = stepped_through(whole.method, problem)
    assert whole.method.estimate(again) == whole.method.estimate(state)
    for mine, theirs in zip(
        (again.resampled.ancestor, again.resampled.moved),
        (state.resampled.ancestor, state.resampled.moved),
        strict=True,
    ):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.slow
def test_where_chains_find_no_way_to_violations_they_go_on_from_those_that_were_met():
    """A pole at 2.0e-5 that starts anywhere, of whose state proposals see half.

    Of eight intervals of which each holds with 0.95, less than seven do with probability 0.06; with
    one move from where proposals have sampled five do, and one answer is a third low.
    """
    (problem,) = chosen(["CartPole, started anywhere, base 3"])
    ratios, holding = list[float](), 0
    for seed in range(8):
        config = ExperimentConfig(
            spec=problem.spec, max_rollouts=20_000, seed=seed, plan=False, measured_memory=False
        )
        found = run(experiment_of(problem, config)).estimate
        ratios.append(found.probability / problem.truth)
        holding += found.ci_low < problem.truth < found.ci_high
    assert holding >= 7
    assert min(ratios) > 0.75
