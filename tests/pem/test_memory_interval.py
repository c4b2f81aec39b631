"""Intervals of a memory against closed forms: quadratic log likelihoods, Student's t."""

import math

import numpy as np
import pytest
from scipy.stats import t as student_t

from pemviz.pem.fitting.memory import (
    FRAILTY,
    FRAILTY_GRID,
    TAU,
    TAU_GRID_S,
    Surface,
    fit_memory,
    independence_p_value,
    inflations,
    interval,
    log_likelihoods,
)
from pemviz.pem.judging.independence import POWER, check_independence, expected_gain, needed_sample
from pemviz.pem.judging.memory_report import sample_outcomes
from pemviz.pem.models.memory import Memory
from tests.pem.synthetic_tracks import draw_tracks, tracks_of

LOG_TAU = np.log(TAU_GRID_S[1:])
CENTRE = np.array([math.log(0.2), 1.6])
BOTH = np.array([-1.0, 1.0])
BENDS = np.array([[90.0, 25.0], [25.0, 40.0]])


def quadratic(centre, bends):
    """A log likelihood ``[taus, frailties]`` with its peak and minus its second derivatives."""
    x, f = np.meshgrid(LOG_TAU - centre[0], FRAILTY_GRID - centre[1], indexing="ij")
    values = -0.5 * (bends[0, 0] * x**2 + 2 * bends[0, 1] * x * f + bends[1, 1] * f**2)
    return np.concatenate([values[:1], values])


def as_surface(log_likelihood):
    # f far from 0: the mirrored spline is a cubic's distance from the quadratic
    return Surface(log_likelihood[:, 2:], TAU_GRID_S, FRAILTY_GRID[2:])


@pytest.mark.parametrize("inflation", [1.0, 2.5])
@pytest.mark.parametrize("sequences", [5, 19])
def test_an_interval_of_a_quadratic_is_students(inflation, sequences):
    whole = as_surface(quadratic(CENTRE, BENDS))
    np.testing.assert_allclose(whole.peak[0], CENTRE, atol=1e-5)
    errors = np.sqrt(np.diag(np.linalg.inv(BENDS)) * inflation)
    reach = student_t.ppf(0.975, sequences - 1) * errors
    tau_s = interval(whole, TAU, inflation=inflation, sequences=sequences)
    np.testing.assert_allclose(np.log(tau_s), CENTRE[TAU] + reach[TAU] * BOTH, atol=2e-3)
    f = interval(whole, FRAILTY, inflation=inflation, sequences=sequences)
    expected = np.clip(CENTRE[FRAILTY] + reach[FRAILTY] * BOTH, 0.5, 3.0)
    np.testing.assert_allclose(f, expected, atol=2e-3)


def test_sequences_that_differ_more_than_the_likelihood_says_widen_it():
    """Quadratics: leaving one out is solved exactly, by linear algebra."""
    random = np.random.default_rng(3)
    centres = CENTRE + random.normal(0.0, 1.0, (12, 2)) * [0.8, 0.5]
    shares = random.uniform(0.5, 2.0, 12)
    bends = shares[:, None, None] * BENDS / 12
    surfaces = np.array([quadratic(c, b) for c, b in zip(centres, bends, strict=True)])

    def solved(rows):
        weight = bends[rows].sum(axis=0)
        return np.linalg.solve(weight, np.einsum("nij,nj->i", bends[rows], centres[rows]))

    every = np.arange(12)
    without = np.array([solved(every[every != left_out]) for left_out in every])
    variance = 11 / 12 * np.sum((without - solved(every)) ** 2, axis=0)
    expected = variance / np.diag(np.linalg.inv(bends.sum(axis=0)))
    assert (expected > 1.0).all()
    whole = as_surface(surfaces.sum(axis=0))
    found = inflations(surfaces[:, :, 2:], whole, step_s=whole.tau_s)  # there log tau is straight
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_sequences_that_agree_leave_the_likelihoods_own_width():
    surfaces = np.array([quadratic(CENTRE, BENDS / 8)] * 8)
    whole = as_surface(surfaces.sum(axis=0))
    found = inflations(surfaces[:, :, 2:], whole, step_s=0.1)
    np.testing.assert_array_equal(found, [1.0, 1.0])


def test_the_p_value_of_independence_is_that_of_the_ratio():
    whole = as_surface(quadratic(CENTRE, BENDS))
    x = LOG_TAU[0] - CENTRE[0]
    best_f = np.clip(CENTRE[1] - BENDS[0, 1] / BENDS[1, 1] * x, 0.5, 3.0)
    clipped = best_f - CENTRE[1]
    at_zero = -0.5 * (BENDS[0, 0] * x**2 + 2 * BENDS[0, 1] * x * clipped
                      + BENDS[1, 1] * clipped**2)  # fmt: skip
    inflation = 60.0
    found = independence_p_value(whole, inflation=inflation, sequences=9)
    expected = student_t.sf(math.sqrt(-2.0 * at_zero / inflation), 8)
    assert found == pytest.approx(expected, rel=1e-3)


def test_the_fit_is_the_maximum_of_the_likelihood():
    """Against the likelihood itself on a grid ten times finer around it."""
    table, own = draw_tracks(seed=4, tau_s=0.15, frailty=1.0, sequences=8)
    fit = fit_memory(table, own)
    taus_s = fit.memory.tau_s * np.exp(np.linspace(-0.1, 0.1, 21))
    frailties = fit.memory.frailty + np.linspace(-0.1, 0.1, 21)
    values = log_likelihoods(table, own, taus_s=taus_s, frailties=frailties).sum(axis=0)
    row, column = np.unravel_index(values.argmax(), values.shape)
    assert taus_s[row] == pytest.approx(fit.memory.tau_s, rel=0.02)
    assert frailties[column] == pytest.approx(fit.memory.frailty, abs=0.02)
    assert -values.max() / len(table) == pytest.approx(fit.nats, abs=1e-4)


def constant_tracks(own_miss, *, tracks=300, frames=6):
    """Tracks in a constant state, detected throughout."""
    count = tracks * frames
    track = np.repeat(np.arange(tracks), frames)
    who = {"sequence": track % 10, "track": track, "frame": np.tile(np.arange(frames), tracks)}
    table = tracks_of(np.ones(count), **who)
    return table, np.full(count, math.log((1.0 - own_miss) / own_miss))


def test_the_expected_gain_is_that_of_a_chain_by_hand():
    table, own = constant_tracks(0.2)
    rho, pairs = math.exp(-0.1 / 0.1), 300 * 5
    again, first = 0.2 + 0.8 * rho, 0.2 * (1 - rho)
    by_hand = 0.2 * (again * math.log(again / 0.2) + (1 - again) * math.log((1 - again) / 0.8))
    by_hand += 0.8 * (first * math.log(first / 0.2) + (1 - first) * math.log((1 - first) / 0.8))
    found = expected_gain(table, own, frailty=0.0, tau_s=0.1)
    assert found == pytest.approx(pairs * by_hand, rel=1e-9)


def test_the_expected_gain_is_the_mean_of_gains():
    """Over 40 draws, to five standard errors."""
    table, own = draw_tracks(seed=6, tau_s=0.0, frailty=0.0, sequences=6)
    random, gains = np.random.default_rng(8), []
    for _ in range(40):
        detected = sample_outcomes(table, own, memory=Memory(tau_s=0.1), random=random)
        sampled = tracks_of(detected, sequence=table.sequence, track=table.track, frame=table.frame)
        both = log_likelihoods(sampled, own, taus_s=np.array([0.0, 0.1]), frailties=np.zeros(1))
        gains.append(np.diff(both.sum(axis=0)[:, 0])[0])
    error = np.std(gains) / math.sqrt(len(gains))
    assert abs(np.mean(gains) - expected_gain(table, own, frailty=0.0, tau_s=0.1)) < 5 * error


def test_shorter_memories_need_more_video():
    table, own = draw_tracks(seed=5, tau_s=0.0, frailty=0.0, sequences=12)
    fit = fit_memory(table, own)
    needed = check_independence(table, own, fit=fit).needed
    sizes = [each.sequences for each in needed]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > 100 > 2 * sizes[-1]
    pairs_each = table.follows.sum() / 12
    assert all(each.pairs == round(pairs_each * each.sequences) for each in needed)


def test_the_power_that_is_promised_is_had():
    """Of 16 samples of the size that 80 % find, fewer than 8 do so in one of 600 seeds."""
    template, own = draw_tracks(seed=9, tau_s=0.0, frailty=0.0, tracks_each=6)
    needed = needed_sample(template, own, fit=fit_memory(template, own), tau_s=0.06)
    found = 0
    for seed in range(16):
        table, logit = draw_tracks(
            seed=100 + seed, tau_s=0.06, frailty=0.0, sequences=needed.sequences, tracks_each=6
        )
        found += fit_memory(table, logit).p_value < 0.05
    assert POWER == 0.8
    assert found >= 8


def test_independent_misses_are_seldom_refused():
    """Of 16 samples at 5 % false alarm, more than 4 are refused in one of 10^3 seeds."""
    refused = 0
    for seed in range(16):
        table, logit = draw_tracks(
            seed=200 + seed, tau_s=0.0, frailty=0.0, sequences=6, tracks_each=5
        )
        refused += fit_memory(table, logit).p_value < 0.05
    assert refused <= 4
