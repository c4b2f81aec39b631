"""What to label next: against exact recursions, closed forms, and collecting what is asked for."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pemviz.analysis.band_models import (
    BANDS,
    BandOutcomes,
    band_model,
    band_outcomes,
    visited_salient,
)
from pemviz.analysis.data_plan import labels_to_halve, refit_plan, sequences_for
from pemviz.analysis.label_plan import (
    POWER,
    LabelledBand,
    cheapest_requirement,
    label_plan,
    labelled,
)
from pemviz.analysis.model_uncertainty import data_bound
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.pem import SupportSummary, data_bound_pem, support_of
from pemviz.pem.data.support import SHAPE, kinds_and_bands
from pemviz.pem.models.protocol import as_rows
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.zero_variance.reachable_states import explore
from pemviz.sampling.zero_variance.values import solve

SHORT = ExperimentConfig(
    method="mixture",
    scenario=ScenarioConfig(states=40, dt_s=0.1),
    spec="always[0,39] (gap >= 2.0)",
)
NEAR, MIDDLE, FAR = 2, 3, 4
"""Bands of distance: 3 to 5 m, 5 to 7 m, 7 to 13 m."""
TARGET = 1e-6


@pytest.fixture(scope="module")
def experiment():
    return build_experiment(SHORT)


@pytest.fixture(scope="module")
def problem(experiment):
    return replace(experiment.problem, simulator=experiment.twin)


def exact(problem, pem):
    """The failure probability under a model, by recursion over all reachable states."""
    graph = explore(twin=problem.simulator, pem=pem, unsafe=problem.unsafe)
    return math.exp(solve(graph).log_probability)


@pytest.fixture(scope="module")
def drawn(experiment, problem):
    """Violations drawn for a model that misses 5 % everywhere."""
    miss = np.full(BANDS, 0.05)
    return band_outcomes(problem, miss=miss, features=experiment.features, seed=0)


@pytest.fixture(scope="module")
def planned(experiment, problem):
    return label_plan(
        problem,
        features=experiment.features,
        support=support_of(experiment.pem),
        target=TARGET,
        log_probability=math.log(2.593e-8),
        elasticity=6.0,
        seed=0,
    )


def test_violations_drawn_once_serve_the_models_nearby(problem, drawn):
    """Three z-tests at 4 standard errors: false alarm 2e-4 together; the seed is fixed."""
    for near, middle, far in ((0.05, 0.05, 0.05), (0.03, 0.06, 0.04), (0.2, 0.1, 0.05)):
        miss = np.full(BANDS, 0.05)
        miss[[NEAR, MIDDLE, FAR]] = near, middle, far
        truth = exact(problem, band_model(miss))
        error = 4.0 / math.sqrt(drawn.effective_failures(miss))
        assert math.exp(drawn.log_probability(miss)) == pytest.approx(truth, rel=error)


def test_elasticities_are_the_recursions(problem, drawn):
    miss = np.full(BANDS, 0.05)
    higher = miss.copy()
    higher[FAR] *= 1.01
    slope = math.log(exact(problem, band_model(higher)) / exact(problem, band_model(miss)))
    assert drawn.slopes(miss)[FAR] == pytest.approx(slope / math.log(1.01), rel=0.05)


def test_what_the_data_allow_is_told_where_plain_simulation_sees_little(experiment, problem):
    """An upper 95 % bound from 560 rollouts: at least the truth, and not by much."""
    salient = visited_salient(problem)
    truth = exact(problem, data_bound_pem(salient, support=support_of(experiment.pem)))
    plain = data_bound(problem, seed=0)
    sharp = data_bound(problem, seed=0, sharpened_by=experiment.features)
    assert plain.failures < 100
    assert truth < sharp.probability < 1.5 * truth
    assert sharp.rollouts < plain.rollouts


def two_bands(first, second):
    """A failure takes ``first`` misses in one band and ``second`` in another: u1^m1 u2^m2."""
    misses = np.zeros((1, BANDS))
    misses[0, [MIDDLE, FAR]] = first, second
    return BandOutcomes(np.zeros(1), misses, np.zeros((1, BANDS)), 1, np.empty((0, 11)))


def test_the_cheapest_requirement_is_lagranges():
    """Costs fall as 1 / u: at the optimum they are in proportion to the exponents."""
    bands = [LabelledBand(band, 0, 0, 0.0) for band in (MIDDLE, FAR)]
    target = math.log(1e-8)
    required = cheapest_requirement(
        two_bands(1, 3), bands=bands, log_target=target, confidence=0.975, power=0.95
    )
    first, second = required[[MIDDLE, FAR]]
    assert math.log(first) + 3 * math.log(second) == pytest.approx(target, abs=1e-4)
    assert first / second == pytest.approx(3.0, rel=0.05)


def test_where_the_detector_misses_too_often_it_has_to_become_better():
    bands = [LabelledBand(MIDDLE, 0, 0, 0.02), LabelledBand(FAR, 0, 0, 0.02)]
    settings = {"bands": bands, "confidence": 0.975, "power": 0.95}
    much = cheapest_requirement(two_bands(2, 2), log_target=math.log(1e-6), **settings)
    little = cheapest_requirement(two_bands(2, 2), log_target=math.log(1e-9), **settings)
    assert (much[[MIDDLE, FAR]] > 0.02).all()
    assert (little[[MIDDLE, FAR]] < 0.02).any()


def test_a_plan_asks_where_violations_come_from(planned):
    plan, _ = planned
    assert [(band.low_m, band.high_m) for band in plan.bands] == [(3, 5), (5, 7), (7, 13)]
    far = plan.bands[-1]
    assert (far.obstacles, far.missed) == (132, 0)
    assert far.required < far.allowed
    assert far.fewest_labels < far.labels
    assert plan.warning is None
    assert "Car" in plan.obstacle


def test_collecting_what_is_asked_for_shows_the_target(experiment, problem, planned):
    """Thirty samples of a detector that is as the model says; bounds by exact recursion.

    Each shows the target with a probability of at least 0.9 and holds the truth with at least
    0.95: fewer than 22 and 24 of 30 have a probability of 0.0020 and 0.0006 at most. Fixed seed.
    """
    plan, outcomes = planned
    salient = visited_salient(problem)
    kind, _ = kinds_and_bands(as_rows(salient)[0])
    before = labelled(salient, support_of(experiment.pem))
    truth = np.full(BANDS, 0.02)
    index = [2, 3, 4]
    truth[index] = [band.model for band in plan.bands]
    probability = exact(problem, band_model(truth))
    generator = np.random.default_rng(20261122)
    bounds = []
    for _ in range(30):
        obstacles, missed = np.zeros(SHAPE, dtype=np.int64), np.zeros(SHAPE, dtype=np.int64)
        obstacles[tuple(kind[0])], missed[tuple(kind[0])] = before.obstacles, before.missed
        for band, planned_band in zip(index, plan.bands, strict=True):
            obstacles[(*kind[0], band)] += planned_band.labels
            missed[(*kind[0], band)] += generator.binomial(planned_band.labels, truth[band])
        allowed = data_bound_pem(salient, support=SupportSummary(obstacles, missed))
        bounds.append(exact(problem, allowed))
    assert probability < TARGET
    assert plan.power == POWER
    assert np.count_nonzero(np.array(bounds) <= TARGET) >= 22
    assert np.count_nonzero(np.array(bounds) >= probability) >= 24
    assert outcomes.log_rest.size > 0


def test_labels_that_halve_a_spread():
    """Refits spread as Beta samples with 4 misses: half that spread takes the misses of a fourth.

    trigamma(4) = 0.283823, and trigamma(14.602) is a quarter of it.
    """
    generator = np.random.default_rng(1)
    log_missed = np.log(generator.beta(4.0, 396.0, size=4000))
    labels = labels_to_halve(log_missed)
    assert labels == pytest.approx((14.602 - 4.0) / math.exp(log_missed.mean()), rel=0.1)


def test_the_range_over_refits_comes_from_where_they_differ(experiment, planned):
    _, outcomes = planned
    bands = refit_plan(outcomes, pem=experiment.pem, members=experiment.ensemble.members)
    assert sum(band.contribution for band in bands) > 0.8
    assert max(bands, key=lambda band: band.contribution).low_m == 7.0
    assert all(band.labels > 0 and band.spread > 1.0 for band in bands)


def test_four_times_the_sequences_halve_an_interval_and_student_asks_a_little_more():
    many = sequences_for(half_width=1.0, sequences=1000, wanted=0.5, confidence=0.95)
    few = sequences_for(half_width=1.0, sequences=5, wanted=0.5, confidence=0.95)
    assert many == pytest.approx(4000, rel=0.01)
    assert few < 20  # Student's t of 4 degrees of freedom is wider than that of many
