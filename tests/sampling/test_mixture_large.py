"""Large stages and final batches of mixture: what joins the pool, and that answers stay."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.arrays import at_most
from pemviz.config import ExperimentConfig
from pemviz.proposals.latent_moves import LatentDecisions, LatentMeans
from pemviz.proposals.offset_logistic import Monomials, PolynomialBasis
from pemviz.proposals.start_moves import StartMoves
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.mixture.balance_heuristic import PLAIN, balance_weights, latent_ratios
from pemviz.sampling.mixture.estimate import disagreements
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.mixture.pooling import Terms, extended
from pemviz.sampling.mixture.stages import InParts, Joining
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_recursion,
    toy_problem_of,
)
from tests.sampling.test_mixture_exploring import EARLY, probabilities, run
from tests.toy import simulated_in, stepped_through

WALK, PEM = ToySimulator(initial_gap=6, states=18), ToyPem(at_zero=2.5)


def ended(problem, *, seed, enough, rollouts=400, repetition=0):
    method = MixtureSampling(
        learning_stages=4, rollouts=rollouts, final_rollouts=60, seed=seed, enough=enough
    )
    return method, *stepped_through(method, problem, repetition=repetition)


@pytest.fixture
def few_others(monkeypatch):
    """Of rollouts that hold few are held, so that most of a stage is told by its number alone."""
    monkeypatch.setattr("pemviz.sampling.rollouts.large_stages.EVEN", 20)
    monkeypatch.setattr("pemviz.sampling.rollouts.large_stages.LISTED", 3)


def test_a_stage_is_over_with_the_part_that_brings_enough(few_others):
    problem = replace(toy_problem_of(WALK, PEM), thins=True)
    method, state, results = ended(problem, seed=3, enough=20)
    drawn = [stage.count for stage in results[:-1]]
    for stage in results[:-1]:
        violated = stage.sampled.violated
        assert stage.count % 5 == 0
        assert int(violated[:-5].sum()) < 20
        assert stage.count == 400 or 20 <= violated.sum() < 25
        assert stage.scored.rollouts.count < stage.count or stage.count <= 25
    assert drawn[0] > 50 > min(drawn)
    answer = method.estimate(state)
    assert answer.rollouts_in_estimate == sum(drawn) + 60
    assert answer.rollouts_simulated == simulated_in(results)
    pool = state.pool
    assert pool.count < pool.sampled == pool.judged.violated.size
    counts = [stage.failures for stage in results]
    assert int(pool.judged.violated.sum()) == sum(counts)
    told = np.concatenate(
        [s.scored.violated if s.sampled is None else s.sampled.violated for s in results]
    )
    np.testing.assert_array_equal(pool.judged.violated, told)


def test_others_stand_for_all_that_hold(few_others):
    """They and the least robust count as many as were drawn; each part is drawn with its number."""
    problem, seen = replace(toy_problem_of(WALK, PEM), thins=True), []
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
    problem = toy_problem_of(WALK, PEM)
    _, state, results = ended(problem, seed=3, enough=400, rollouts=200)
    moves = state.pool.proposals[1]
    terms = Terms(features=state.features, basis=state.basis, defensive=0.1)
    pools = {"all": None, "few": None}
    for stage in (0, 1, 5):
        scored = results[stage].scored
        component = 2 * (np.arange(scored.rollouts.count) * min(stage, 1) % 2)
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
    assert few.count < whole.count == whole.sampled == few.sampled == 460
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
    problem = replace(toy_problem_of(WALK, pem), thins=True)
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


NARROW_WALK = ToySimulator(initial_gap=4, largest_gap=6, states=13)
RULES = {"touch": "always[0,12] (gap >= 0.5)", "deep": "always[0,12] (gap >= -2.5)"}


@pytest.fixture(scope="module")
def ends():
    """Of the same run in four parts: rows of all kept, of violations alone, these in pieces."""
    found = {"few": ended_in_parts(many=False)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pemviz.sampling.mixture.pooling.FAILING_AT_ONCE", 7)
        patch.setattr("pemviz.sampling.mixture.balance_heuristic.ROWS_AT_ONCE", 5)
        patch.setattr("pemviz.proposals.offset_logistic.ROLLOUTS_AT_ONCE", 23)
        found["pieces"] = ended_in_parts(many=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MixtureSampling, "_planned", lambda *_, **__: None)
        found["all"] = ended_in_parts(many=False)
    return found


def ended_in_parts(**how):
    config = ExperimentConfig(method="mixture", rollouts=60, stages=3, final_rollouts=300, seed=5)
    experiment = build_experiment(
        config.with_rules(RULES), simulator=NARROW_WALK, pem=ToyPem(at_zero=1.6), twin=NARROW_WALK
    )
    method, problem = replace(experiment.method, largest_part=90), experiment.problem
    state = method.init(problem, repetition=0)
    assert state.many
    state, results = stepped_through(method, problem, replace(state, **how))
    assert results[-1].stage == 7
    return method, state


@pytest.mark.parametrize("name", ["few", "pieces"])
@pytest.mark.parametrize("rule", [None, *RULES])
def test_answers_are_the_same_to_the_last_bit(ends, name, rule):
    (method, whole), (_, few) = ends["all"], ends[name]
    if rule is not None:
        whole, few = (method.under_rule(state, rule) for state in (whole, few))
    expected, violated = method.estimate(whole), whole.pool.judged.violated
    assert 20 < expected.failures < 500
    assert method.estimate(few) == expected
    weights = method.pooled_log_weight(few)
    np.testing.assert_array_equal(weights[violated], method.pooled_log_weight(whole)[violated])
    np.testing.assert_array_equal(few.pool.judged.violated, violated)
    np.testing.assert_array_equal(few.pool.component, whole.pool.component)


def test_of_a_final_batch_the_weights_of_violations_are_kept(ends):
    whole, few = (ends[name][1].pool for name in ("all", "pieces"))
    learned, plain = whole.count - 300, whole.component[: 4 * 60] == PLAIN
    final = slice(learned, None)
    violations = int(whole.violated[final].sum())
    assert 20 < violations < 300
    held = plain & ~whole.judged.violated[: 4 * 60]
    assert few.count == whole.count == 4 * 60 - held.sum() + 300
    assert len(whole.log_ratio) == whole.count
    for ratio in (few.log_ratio, *few.rule_log_ratio.values()):
        assert len(ratio) == learned
    assert sum(part.rollout.size for part in few.failing) == violations
    assert max(part.rollout.size for part in few.failing) <= 7
    assert isinstance(few.decisions.basis, Monomials)
    np.testing.assert_array_equal(few.decisions.basis[:], whole.decisions.basis)
    weighed = np.flatnonzero(~np.isnan(few.log_weight))
    expected = np.r_[np.arange(learned), learned + np.flatnonzero(whole.violated[final])]
    np.testing.assert_array_equal(weighed, expected)


@pytest.mark.parametrize("once", [False, True])
def test_latents_of_many_are_judged_in_pieces_alike(once, monkeypatch):
    """Monomials that are made when asked for, of rollouts with few steps, many or none.

    To the last bit; where one step is moved to 1e-12, as its steps are summed in a table.
    """
    generator = np.random.default_rng(8)
    basis = PolynomialBasis(np.zeros(3), np.ones(3), degree=2)
    steps = generator.integers(0, 9, size=70) * (generator.random(70) < 0.8)
    rollout = np.repeat(np.arange(70), steps)
    features = generator.normal(size=(rollout.size, 3))
    made = LatentDecisions(
        start=generator.normal(size=(70, 2)),
        rollout=rollout,
        monomials=basis.evaluate(features),
        noise=generator.normal(size=(rollout.size, 2)),
        even=generator.normal(size=rollout.size),
        broken=generator.random((rollout.size, 2)) < 0.2,
    )
    kept = replace(made, monomials=Monomials(features, basis))
    size = len(basis.exponents)
    means = LatentMeans(
        start=StartMoves.unmoved(2),
        noise=generator.normal(size=(2, size)),
        choice=generator.normal(size=size),
        sd=np.array([0.4, 0.9]),
        once=once,
    )
    moves = [(means, None), (means, "deep")]
    monkeypatch.setattr("pemviz.proposals.offset_logistic.ROLLOUTS_AT_ONCE", 16)
    for under in (None, "touch"):
        found, expected = (
            latent_ratios(one, moves, rules=("touch", "deep"), under=under) for one in (kept, made)
        )
        np.testing.assert_allclose(found, expected, rtol=1e-12 if once else 0.0, atol=0.0)
    some = generator.random(rollout.size) < 0.5
    few = np.flatnonzero(generator.random(70) < 0.3)
    parts = kept.between(0, 30).joined(made.between(30, 70)), kept.where(some), kept.of(few)
    wanted = made, made.where(some), made.of(few)
    joined = kept.joined(kept)
    assert all(isinstance(one.monomials, Monomials) for one in (joined, parts[1]))
    for found, expected in [*zip(parts, wanted, strict=True), (joined, made.joined(made))]:
        for name in ("start", "rollout", "basis", "noise", "even"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)


@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 300),
    most=st.integers(1, 200),
    spread=st.sampled_from([0.0, 1.0, 6.0]),
)
def test_weight_stays_where_it_is(seed, count, most, spread):
    """Up to each rollout, the weight of those before it is right to within one that is drawn."""
    generator = np.random.default_rng(seed)
    weight = np.exp(spread * generator.normal(size=count)) * (generator.random(count) < 0.7)
    found = at_most(weight, most)
    if np.count_nonzero(weight) <= most:
        assert found is weight
        return
    step = weight.sum() / most
    assert np.count_nonzero(found) <= most
    assert not found[weight == 0.0].any()
    np.testing.assert_allclose(found.sum(), weight.sum(), rtol=1e-12)
    off = np.cumsum(found) - np.cumsum(weight)
    assert np.abs(off).max() <= step * (1.0 + 1e-9)


@pytest.mark.parametrize("most", [40, 10**6])
def test_an_answer_from_bounded_fits_is_right(monkeypatch, most):
    """Within four standard errors of the exact probability: false alarm 6e-5; as from all."""
    monkeypatch.setattr("pemviz.sampling.mixture.fit.MOST_LEARNED", most)
    pem = ToyPem(at_zero=3.0)
    _, truth = probabilities(EARLY, pem)
    estimate, _ = run(toy_problem_of(EARLY, pem))
    assert estimate.failures > 10 * 40
    assert estimate.std_error < 0.2 * truth
    assert abs(estimate.probability - truth) < 4.0 * estimate.std_error
