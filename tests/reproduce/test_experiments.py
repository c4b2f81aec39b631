import numpy as np
import pytest

from pemviz import stl
from pemviz.config import ExperimentConfig
from pemviz.pem import load_pem
from pemviz.proposals.fixed import ConstantProposal
from pemviz.reproduce.experiments import (
    METRICS,
    exact_reference,
    find_least_safe,
    metric_experiments,
    run_repetition,
    table_2_experiments,
)
from pemviz.reproduce.published import AUTHORS_PEM_DIGEST
from pemviz.runs.engine import run_experiment
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.problem import sample
from tests.reproduce.quick import QUICK


def test_the_rows_are_the_papers():
    base = QUICK.base
    rows = table_2_experiments(QUICK)
    assert list(rows) == ["mc_10", "mc_40", "naive_10", "naive_30", "adaptive_20"]
    assert [c.method for c in rows.values()] == ["monte-carlo"] * 2 + ["naive"] * 2 + ["adaptive"]
    assert [c.final_rollouts for c in rows.values()] == [10, 40, 10, 30, 20]
    assert {c.scenario for c in rows.values()} == {base.scenario}
    assert list(metric_experiments(QUICK)) == ["classical", "agm", "smooth-cumulative"]
    # what two tables share is one experiment
    assert rows["adaptive_20"] == metric_experiments(QUICK)["classical"]


@pytest.mark.parametrize("name", ["naive_10", "adaptive_20"])
def test_a_repetition_is_that_of_a_run_to_the_last_bit(name):
    config = table_2_experiments(QUICK)[name]
    outcomes = [run_repetition(config, number) for number in (1, 0)]
    whole = run_experiment(
        ExperimentConfig(**{**vars(config), "repetitions": 2})  # frozen: vars are the fields
    )
    assert whole.repetitions == (outcomes[1].estimate, outcomes[0].estimate)


def test_curves_are_of_every_learning_stage():
    outcome = run_repetition(QUICK.adaptive("agm"), 0)
    assert sorted(outcome.curves) == [0, 1, 2, 3, 4]
    for curve in outcome.curves.values():
        assert curve.shape == (201,)
        assert ((curve > 0.0) & (curve < 1.0)).all()


def test_the_least_safe_hold_and_nothing_that_holds_is_less_safe():
    search = find_least_safe(QUICK.experiment, METRICS, 1500)
    experiment = build_experiment(QUICK.experiment)
    scored = sample(
        experiment.problem,
        proposal=ConstantProposal(0.5),
        count=1500,
        seeds=np.random.SeedSequence(QUICK.seed, spawn_key=(0, 0)),
    )
    gaps = np.asarray(scored.rollouts.signals["gap"])
    margins = gaps.min(axis=1) - 2.0
    holds = margins >= 0.0
    assert search.violating == np.sum(~holds)
    assert 0 < holds.sum() < 1500
    classical, agm, smooth = search.found
    assert classical.margin_m == pytest.approx(margins[holds].min(), abs=1e-12)
    # agm where all holds: the geometric mean of 1 + (gap - 2)/50, minus 1
    agm_scores = np.exp(np.mean(np.log1p((gaps - 2.0) / 50.0), axis=1)) - 1.0
    assert agm.robustness == pytest.approx(agm_scores[holds].min(), rel=1e-9)
    assert agm.rollout == np.flatnonzero(holds)[np.argmin(agm_scores[holds])]
    # smooth-cumulative, positive part: -log(sum exp(-75 log(1+exp(75 f))/75))/75
    inner = np.logaddexp(0.0, 75.0 * (gaps - 2.0)) / 75.0
    smooth_scores = -np.log(np.exp(-75.0 * inner).sum(axis=1)) / 75.0
    assert smooth.robustness == pytest.approx(smooth_scores[holds].min(), rel=1e-9)
    for one in search.found:
        assert one.margin_m >= 0.0
        assert not stl.violated(experiment.formula, {"gap": one.gap_m[None, :]})[0]


def test_a_search_without_anything_that_holds_is_empty():
    config = ExperimentConfig(naive_detection_probability=0.01)
    search = find_least_safe(config, METRICS, 20)
    assert search.violating == 20
    assert search.found == ()


def test_the_reference_of_the_authors_network_is_that_computed_independently(authors_checkpoint):
    config = ExperimentConfig(pem=str(authors_checkpoint))
    assert load_pem(config.pem).digest == AUTHORS_PEM_DIGEST
    reference = exact_reference(config, 1000)
    assert reference.probability == pytest.approx(6.69e-15, rel=0.01)  # 1 % are 3 errors or more
    assert reference.std_error < 0.0035 * reference.probability
