"""Large stages that mixture learns from: when they are over, what joins the pool, the answer."""

from dataclasses import replace

import numpy as np
import pytest

from pemviz.sampling.mixture.balance_heuristic import balance_weights
from pemviz.sampling.mixture.estimate import disagreements
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.mixture.pooling import Terms, extended
from pemviz.sampling.mixture.stages import InParts, Joining
from tests.lattice_walk import ToyPem, ToySimulator, toy_probability_by_recursion
from tests.sampling.test_mixture_exploring import problem_of

WALK, PEM = ToySimulator(initial_gap=6, states=18), ToyPem(at_zero=2.5)


def ended(problem, *, seed, enough, rollouts=400, repetition=0):
    method = MixtureSampling(
        learning_stages=4, rollouts=rollouts, final_rollouts=60, seed=seed, enough=enough
    )
    state, results = method.init(problem, repetition=repetition), []
    while not method.is_done(state):
        state, result = method.step(problem, state)
        results.append(result)
    return method, state, results


@pytest.fixture
def few_others(monkeypatch):
    """Of rollouts that hold few are held, so that most of a stage is told by its number alone."""
    monkeypatch.setattr("pemviz.sampling.rollouts.large_stages.EVEN", 20)
    monkeypatch.setattr("pemviz.sampling.rollouts.large_stages.LISTED", 3)


def test_a_stage_is_over_with_the_part_that_brings_enough(few_others):
    problem = replace(problem_of(WALK, PEM), thins=True)
    method, state, results = ended(problem, seed=3, enough=20)
    drawn = [stage.count for stage in results[:-1]]
    for stage in results[:-1]:
        violated = stage.drawn.violated
        assert stage.count % 5 == 0
        assert int(violated[:-5].sum()) < 20
        assert stage.count == 400 or 20 <= violated.sum() < 25
        assert stage.scored.rollouts.count < stage.count or stage.count <= 25
    assert drawn[0] > 50 > min(drawn)
    answer = method.estimate(state)
    assert answer.rollouts_simulated == answer.rollouts_in_estimate == sum(drawn) + 60
    pool = state.pool
    assert pool.count < pool.drawn == pool.judged.violated.size
    counts = [stage.failures for stage in results]
    assert int(pool.judged.violated.sum()) == sum(counts)
    told = np.concatenate(
        [s.scored.violated if s.drawn is None else s.drawn.violated for s in results]
    )
    np.testing.assert_array_equal(pool.judged.violated, told)


def test_others_stand_for_all_that_hold(few_others):
    """They and the least robust count as many as were drawn; each part is drawn with its number."""
    problem, seen = replace(problem_of(WALK, PEM), thins=True), []
    method = MixtureSampling(learning_stages=1, rollouts=400, final_rollouts=9, seed=1, enough=40)
    state, result = method.step(problem, method.init(problem, repetition=0))
    pool = state.pool
    stands_for = np.exp(pool.log_stands_for)
    assert stands_for.sum() == pytest.approx(result.count)
    assert (stands_for[pool.violated] == 1.0).all()
    assert stands_for.max() > 5.0
    own = balance_weights(pool.log_ratio, pool.component)
    np.testing.assert_array_equal(pool.log_weight, own + pool.log_stands_for)
    told = []
    counting = replace(problem, progress=lambda done, of: told.append((done, of)))

    def part(watched, number, size):
        seen.append((number, size))
        watched.progress(size, size)
        return result.scored.take(slice(size))

    InParts(count=23, enough=40).sample(counting, part)
    assert seen == [(0, 8), (1, 8), (2, 7)]
    assert told == [(8, 23), (16, 23), (23, 23)]


def test_weights_do_not_depend_on_what_is_held():
    """The same rollouts and proposals, all in the pool or few: to the last bit."""
    problem = problem_of(WALK, PEM)
    _, state, results = ended(problem, seed=3, enough=400, rollouts=200)
    moves = state.pool.proposals[0]
    terms = Terms(features=state.features, basis=state.basis, defensive=0.1)
    pools = {"all": None, "few": None}
    for stage in (0, 1, 5):
        scored = results[stage].scored
        component = np.arange(scored.rollouts.count) * min(stage, 1) % 2
        for name, pool in pools.items():
            rows = np.flatnonzero(scored.violated | (np.arange(scored.rollouts.count) % 7 == 0))
            few = Joining(scored.take(rows), rows, np.zeros(rows.size))
            known = 0 if pool is None else pool.count
            pools[name] = extended(
                pool,
                few if name == "few" and stage < 5 else Joining(scored),
                component=component,
                new=[(moves, np.zeros(known))] if stage == 1 else (),
                terms=terms,
                last=stage == 5,
            )
    few, whole = pools["few"], pools["all"]
    assert few.count < whole.count == whole.drawn == few.drawn == 460
    judged, bad = few.judged, whole.violated
    np.testing.assert_array_equal(judged.component, whole.component)
    np.testing.assert_array_equal(judged.violated, bad)
    np.testing.assert_array_equal(judged.log_weight[bad], whole.log_weight[bad])
    np.testing.assert_array_equal(judged.log_p[bad], whole.log_p[bad])
    for part in (slice(0, 400), slice(400, None)):
        found, expected = few.weights_among(part), whole.weights_among(part)
        assert found.shape == expected.shape
        np.testing.assert_array_equal(found[bad[part]], expected[bad[part]])
    assert list(disagreements(few, final=part)) == list(disagreements(whole, final=part))


@pytest.mark.slow
@pytest.mark.parametrize("at_zero", [2.5, 4.0])
def test_answers_of_large_stages_are_right(few_others, at_zero):
    """Means of 60 runs within four standard errors of the truth: false alarm 6e-5 each.

    By their intervals: fewer than 48 of 60 that hold it have probability 2e-4 at a true 93 %.
    """
    pem = ToyPem(at_zero=at_zero)
    truth = toy_probability_by_recursion(WALK, pem)
    problem = replace(problem_of(WALK, pem), thins=True)
    found = []
    for repetition in range(60):
        method, state, results = ended(problem, seed=8, enough=40, repetition=repetition)
        assert sum(stage.count for stage in results[:-1]) < 0.6 * 5 * 400
        found.append(method.estimate(state))
    for name in ("probability", "unbiased_probability"):
        ratio = np.array([getattr(one, name) for one in found]) / truth
        error = ratio.std(ddof=1) / np.sqrt(ratio.size)
        assert error < 0.1
        assert abs(ratio.mean() - 1.0) < 4.0 * error
    assert sum(one.ci_low <= truth <= one.ci_high for one in found) >= 48
