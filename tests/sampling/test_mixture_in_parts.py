"""Of a large final batch mixture keeps the weights of violations alone, and answers the same."""

from dataclasses import replace

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.proposals.latent_moves import LatentDecisions, LatentMeans, StartMoves
from pemviz.proposals.offset_logistic import Monomials, PolynomialBasis
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.mixture.balance_heuristic import latent_ratios
from pemviz.sampling.mixture.method import MixtureSampling
from tests.lattice_walk import ToyPem, ToySimulator

WALK = ToySimulator(initial_gap=4, largest_gap=6, states=13)
RULES = {"touch": "always[0,12] (gap >= 0.5)", "deep": "always[0,12] (gap >= -2.5)"}


@pytest.fixture(scope="module")
def ends():
    """Of the same run in four parts: rows of all kept, of violations alone, these in pieces."""
    found = {"few": end(many=False)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pemviz.sampling.mixture.pooling.FAILING_AT_ONCE", 7)
        patch.setattr("pemviz.sampling.mixture.balance_heuristic.ROWS_AT_ONCE", 5)
        patch.setattr("pemviz.proposals.offset_logistic.ROLLOUTS_AT_ONCE", 23)
        found["pieces"] = end(many=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MixtureSampling, "_planned", lambda *_, **__: None)
        found["all"] = end(many=False)
    return found


def end(**how):
    config = ExperimentConfig(method="mixture", rollouts=60, stages=3, final_rollouts=300, seed=5)
    experiment = build_experiment(
        config.with_rules(RULES), simulator=WALK, pem=ToyPem(at_zero=1.6), twin=WALK
    )
    method, problem = replace(experiment.method, largest_part=90), experiment.problem
    state = method.init(problem, repetition=0)
    assert state.many
    state = replace(state, **how)
    while not method.is_done(state):
        state, stage = method.step(problem, state)
    assert stage.stage == 7
    return method, state


@pytest.mark.parametrize("name", ["few", "pieces"])
@pytest.mark.parametrize("rule", [None, *RULES])
def test_answers_are_the_same_to_the_last_bit(ends, name, rule):
    (method, whole), (_, few) = ends["all"], ends[name]
    if rule is not None:
        whole, few = (method.under_rule(state, rule) for state in (whole, few))
    expected, violated = method.estimate(whole), whole.pool.violated
    assert 20 < expected.failures < 500
    assert method.estimate(few) == expected
    weights = method.pooled_log_weight(few)
    np.testing.assert_array_equal(weights[violated], method.pooled_log_weight(whole)[violated])
    np.testing.assert_array_equal(few.pool.violated, violated)
    np.testing.assert_array_equal(few.pool.component, whole.pool.component)


def test_of_a_final_batch_the_weights_of_violations_are_kept(ends):
    whole, few = (ends[name][1].pool for name in ("all", "pieces"))
    learned, final = 4 * 60, slice(4 * 60, None)
    violations = int(whole.violated[final].sum())
    assert 20 < violations < 300
    assert few.count == whole.count == learned + 300
    assert len(whole.log_ratio) == whole.count
    for ratio in (few.log_ratio, *few.rule_log_ratio.values()):
        assert len(ratio) == learned
    assert sum(part.rollout.size for part in few.failing) == violations
    assert max(part.rollout.size for part in few.failing) <= 7
    assert isinstance(few.decisions.basis, Monomials)
    np.testing.assert_array_equal(few.decisions.basis[:], whole.decisions.basis)
    held = np.flatnonzero(~np.isnan(few.log_weight))
    expected = np.r_[np.arange(learned), learned + np.flatnonzero(whole.violated[final])]
    np.testing.assert_array_equal(held, expected)


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
        start=StartMoves(np.zeros(2), np.ones(2)),
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
