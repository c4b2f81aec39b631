"""Why a prediction is off: likelihoods of the decisive window, and intervals of the page."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr, ndtri
from scipy.stats import multivariate_normal

from pemviz.config import ScenarioConfig
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.protocol import SALIENT_COLUMNS
from pemviz.pem.models.varying_frailty import VaryingFrailty
from pemviz.sampling.state.visibility import Visibility
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from studies.detector_in_the_loop.page_words import holds, ratio_of, ratio_words
from studies.detector_in_the_loop.predictions import Answer, coarsened, mixed
from studies.detector_in_the_loop.settings import FAR, SETTINGS
from studies.detector_in_the_loop.study import Truth, by_domain
from studies.detector_in_the_loop.truth import Count, count_block, counted, exact_interval
from studies.detector_in_the_loop.why import (
    Window,
    all_missed,
    all_missed_if_normal,
    lagged,
    log_likelihood,
)

SHARES = np.array([0.9, 0.5, 0.05, 0.3])


@pytest.mark.parametrize(("tau_s", "frailty"), [(0.0, 0.0), (0.2, 0.0), (0.0, 1.2), (0.1, 0.7)])
def test_probabilities_of_all_courses_add_up_to_one(tau_s, frailty):
    every = np.array(list(product([False, True], repeat=4)))
    told = log_likelihood(every, SHARES, tau_s=tau_s, frailty=frailty)
    assert np.exp(told).sum() == pytest.approx(1.0)


def test_without_memory_it_is_a_product():
    missed = np.array([[True, False, True, False]])
    told = log_likelihood(missed, SHARES, tau_s=0.0, frailty=0.0)
    assert np.exp(told[0]) == pytest.approx(0.9 * 0.5 * 0.05 * 0.7)


def test_frailty_is_the_integral_over_a_normal():
    """By Monte Carlo over u: four standard errors, false alarm 6e-5."""
    u = np.random.default_rng(1).standard_normal(400_000)
    moved = ndtri(SHARES) * np.sqrt(1 + 1.2**2) + 1.2 * u[:, None]
    sampled = ndtr(moved).prod(axis=1)
    told = np.exp(log_likelihood(np.ones((1, 4), dtype=bool), SHARES, tau_s=0.0, frailty=1.2)[0])
    assert abs(told - sampled.mean()) < 4.0 * sampled.std() / np.sqrt(u.size)


def test_with_both_it_is_what_runs_of_pemviz_have():
    random = np.random.default_rng(2)
    missed, own = random.random((50, 4)) < 0.5, -np.log(SHARES / (1 - SHARES))
    simulator = VectorizedSimulator(ScenarioConfig(dt_s=0.1))
    visibility = Visibility(Memory(tau_s=0.1, frailty=0.7), simulator.dt_s)
    wanted = visibility.log_likelihood(np.tile(own, (50, 1)), ~missed)
    told = log_likelihood(missed, SHARES, tau_s=0.1, frailty=0.7)
    np.testing.assert_allclose(told, wanted, rtol=1e-9)


def test_a_visibility_misses_two_frames_as_two_normals_do():
    law, shares = VaryingFrailty(0.8, 1.4, 0.3), np.array([0.2, 0.05])
    correlation = (0.8**2 + 1.4**2 * np.exp(-0.1 / 0.3)) / (1.0 + 0.8**2 + 1.4**2)
    normals = multivariate_normal(cov=[[1.0, correlation], [correlation, 1.0]])
    assert all_missed(shares, law) == pytest.approx(normals.cdf(ndtri(shares)), rel=1e-6)


def test_normal_latents_are_found_by_their_pairs():
    """20,000 windows of an autoregression: all missed within a twentieth, four standard errors."""
    random, shares = np.random.default_rng(5), np.array([0.7, 0.4, 0.3, 0.5])
    latents = random.standard_normal((20_000, 4))
    for frame in range(1, 4):
        latents[:, frame] = 0.8 * latents[:, frame - 1] + 0.6 * latents[:, frame]
    missed = latents < ndtri(shares)
    lags = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    wanted = multivariate_normal(cov=0.8**lags).cdf(ndtri(shares))
    found = all_missed_if_normal(Window(np.arange(4.0), missed))
    assert found == pytest.approx(wanted, rel=0.05)
    none = Window(np.arange(4.0), np.zeros((10, 4), dtype=bool))
    assert all_missed_if_normal(none) < 0.05


def truth(failed, rollouts):
    low, high = exact_interval(failed, rollouts)
    return Truth(failed / rollouts, low, high, "counted", Count(failed, rollouts, 0, {}))


def test_a_prediction_over_the_truth_has_both_errors():
    found = truth(100, 10_000)
    exact = ratio_of(Answer(0.015, None, None, ()), found)
    assert exact.value == pytest.approx(1.5)
    assert (exact.low, exact.high) == pytest.approx((0.015 / found.high, 0.015 / found.low))
    wide = ratio_of(Answer(0.015, 0.010, 0.022, ()), found)
    assert wide.low < exact.low < exact.high < wide.high
    assert holds(exact)
    assert not holds(ratio_of(Answer(0.021, None, None, ()), found))
    assert ratio_words(exact).startswith("**1.5 (")
    assert ratio_words(ratio_of(Answer(1e-3, None, None, ()), truth(0, 1000))).startswith("over")


def test_kinds_of_light_and_weather_count_by_their_shares():
    one, other = Answer(0.1, 0.08, 0.12, ()), Answer(0.01, 0.00, 0.02, ())
    both = mixed([(0.25, one), (0.75, other)])
    assert both.probability == pytest.approx(0.0325)
    assert both.high == pytest.approx(0.0325 + np.hypot(0.25 * 0.02, 0.75 * 0.01))


def test_copied_outcomes_are_late():
    """P(missed) of each frame, by enumeration of all courses of the chain."""
    every = np.array(list(product([False, True], repeat=4)))
    chance = np.exp(log_likelihood(every, SHARES, tau_s=0.15, frailty=0.0))
    np.testing.assert_allclose(lagged(SHARES, tau_s=0.15), chance @ every, rtol=1e-12)


def test_a_coarsened_table_has_the_scenarios_car_in_it(tmp_path):
    """A car 0.17 m aside becomes, in every feature, the one that the scenario asks about."""
    table = tmp_path / "tracks.csv"
    names = [*SALIENT_COLUMNS, "detected"]
    gap_m = 20.0
    near = [0, 0, 0, -1.5792, 1.44, 1.8, 4.6, 0.17, 1.65, gap_m + 2.25, -1.571, 1]
    beside = [0, 0, 0, -1.42, 1.8, 1.84, 4.5, -3.46, 1.65, 22.0, -1.5671, 0]
    lines = [",".join(map(str, row)) for row in (near, beside)]
    table.write_text("\n".join([",".join(names), *lines]) + "\n")
    coarsened(table)
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    wanted = FAR.simulator.salient({"gap": np.array([gap_m])})[0]
    np.testing.assert_allclose(rows[0, :-1], wanted, atol=1e-9)
    x_m, z_m, rotation = rows[1, [7, 9, 10]]
    assert (x_m, rows[1, 3]) == pytest.approx((-3.5, rotation - np.arctan2(x_m, z_m)))
    np.testing.assert_array_equal(rows[:, -1], [1, 0])


def test_a_setting_is_counted_until_enough_fail(tmp_path, monkeypatch):
    """A third of each block fails: 400 are there after three of 500; the rest is never driven."""
    driven = []

    def block_of(setting, detector, *, block, rollouts):
        driven.append(block)
        failed = np.arange(rollouts) % 3 == 0
        return SimpleNamespace(failed=failed, looks=SimpleNamespace(step=np.zeros(7)))

    monkeypatch.setattr("studies.detector_in_the_loop.truth.driven_block", block_of)
    setting = next(one for one in SETTINGS if one.name == "far-fair")
    # as processes that are ahead of each other do it
    counts = [count_block(setting, None, tmp_path, block=block) for block in (1, 0, 0, 4, 2, 3, 5)]
    assert (driven, counts) == ([1, 0, 4, 2], [True, True, False, True, True, False, False])
    count = counted(setting, tmp_path)
    assert (count.failed, count.rollouts, count.frames) == (501, 1_500, 21)
    assert counted(setting, tmp_path / "none").rollouts == 0


def test_settings_of_a_domain_are_worked_on_together():
    groups = by_domain(SETTINGS)
    assert sorted(one.name for group in groups for one in group) == sorted(
        one.name for one in SETTINGS
    )
    assert all(len({one.domain_name for one in group}) == 1 for group in groups)
    assert len(groups) == len({one.domain_name for one in SETTINGS})
    assert groups[0][0].domain_name == "all"
