"""Memory of misses: the chain's formula, its likelihood, fits to sampled tracks, intervals."""

import itertools
import math
from dataclasses import replace
from functools import partial
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.special import expit, logit
from scipy.stats import norm
from scipy.stats import t as student_t
from sklearn.model_selection import GroupKFold

from pemviz.pem import PemError
from pemviz.pem.fitting.fit import fit_pem
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
from pemviz.pem.judging.memory_report import (
    CrossFitted,
    closing_speed_mps,
    cross_fit,
    fit_report,
    residual_correlation,
    run_lengths,
    sample_outcomes,
)
from pemviz.pem.models.memory import Memory, frail_logit, persistence, remembering_logit
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS
from tests.pem.synthetic_tracks import draw_tracks, tracks_of

probabilities = st.floats(1e-12, 1.0 - 1e-12)
correlations = st.floats(0.0, 0.999)


@given(p_miss=probabilities, rho=correlations, missed=st.booleans())
def test_conditional_probability_is_the_formula(p_miss, rho, missed):
    own = np.array([logit(1.0 - p_miss)])
    found = remembering_logit(own, missed_before=np.array([missed]), rho=rho)
    p = expit(-own)
    expected = p + (missed - p) * rho
    np.testing.assert_allclose(expit(-found), expected, rtol=1e-9)


@given(own=st.floats(-50.0, 50.0), missed=st.booleans())
def test_without_memory_the_logit_is_the_models_own(own, missed):
    found = remembering_logit(np.array([own]), missed_before=np.array([missed]), rho=0.0)
    assert found[0] == own


@given(p_miss=st.floats(0.01, 0.9), tau_s=st.floats(0.02, 2.0), dt_s=st.floats(0.02, 0.2))
def test_in_a_constant_state_the_marginal_stays_and_correlation_is_exponential(p_miss, tau_s, dt_s):
    """By enumeration of all chains of five outcomes."""
    rho = float(persistence(dt_s, tau_s))
    chains = list(itertools.product((False, True), repeat=5))
    weight = []
    for chain in chains:
        w = p_miss if chain[0] else 1.0 - p_miss
        for before, now in itertools.pairwise(chain):
            own = np.array([logit(1 - p_miss)])
            miss = expit(-remembering_logit(own, missed_before=np.array([before]), rho=rho)[0])
            w *= miss if now else 1.0 - miss
        weight.append(w)
    missed, weight = np.array(chains, dtype=float), np.array(weight)
    assert weight.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(weight @ missed, p_miss, rtol=1e-9)
    for lag in range(1, 5):
        joint = weight @ (missed[:, 0] * missed[:, lag])
        found = (joint - p_miss**2) / (p_miss * (1.0 - p_miss))
        assert found == pytest.approx(math.exp(-lag * dt_s / tau_s), abs=1e-9)


@pytest.mark.parametrize("p_miss", [1e-9, 1e-3, 0.3, 0.9])
@pytest.mark.parametrize("frailty", [0.3, 1.0, 3.0])
def test_frailty_keeps_the_mean(p_miss, frailty):
    def integrand(u):
        own = np.array([logit(1.0 - p_miss)])
        moved = frail_logit(own, visibility=np.array([u]), frailty=frailty)
        return float(expit(-moved)[0]) * norm.pdf(u)

    mean = quad(integrand, -12.0, 12.0, points=[0.0, 3.0, 6.0], epsabs=1e-14, limit=400)[0]
    assert mean == pytest.approx(p_miss, rel=1e-6)


@pytest.mark.parametrize("scale", [0.1, 3.0, 40.0, 900.0])
def test_each_outcome_remembered_is_the_sum_of_two_ways(scale):
    """log(P(fresh) + P(kept)) of both outcomes, as the formula says it, to the last bit."""
    rng = np.random.default_rng(8)
    own = np.concatenate([scale * rng.standard_normal(500), [0.0, 1e-300, np.log(2.0)]])
    missed, rho = rng.random(own.size) < 0.5, rng.random(own.size)
    found = remembering_logit(own, missed_before=missed, rho=rho)
    kept = np.log(rho)
    hit = np.logaddexp(np.log1p(-rho) - np.logaddexp(0.0, -own), np.where(missed, -np.inf, kept))
    miss = np.logaddexp(np.log1p(-rho) - np.logaddexp(0.0, own), np.where(missed, kept, -np.inf))
    np.testing.assert_array_equal(found, hit - miss)


def small_tracks():
    """Three tracks of two sequences: a gap, two rates, one that is seen once."""
    rows = [
        (0, 1, 0, 10.0, True), (0, 1, 1, 10.0, False), (0, 1, 4, 10.0, False),
        (1, 1, 5, 10.0, False), (1, 1, 6, 20.0, True), (1, 1, 7, 20.0, False),
        (1, 2, 0, 10.0, False),
    ]  # fmt: skip
    sequence, track, frame, rate, detected = (np.array(c) for c in zip(*rows, strict=True))
    table = tracks_of(detected, sequence=sequence, track=track, frame=frame, rate_hz=rate)
    return table, np.array([2.0, 1.0, 0.5, 1.5, 0.2, -0.3, 0.7])


def naive_log_likelihood(rows, tau_s, frailty):
    """Of one track: (P(missed), missed, seconds since), u integrated out by scipy."""

    def chain(u):
        product, before = 1.0, None
        for p, missed, since_s in rows:
            own = norm.cdf(norm.ppf(p) * math.sqrt(1 + frailty**2) + frailty * u)
            rho = 0.0 if before is None or tau_s == 0 else math.exp(-since_s / tau_s)
            miss = own + (float(bool(before)) - own) * rho
            product *= miss if missed else 1.0 - miss
            before = missed
        return product

    if frailty == 0.0:
        return math.log(chain(0.0))
    return math.log(quad(lambda u: chain(u) * norm.pdf(u), -8, 8, epsabs=1e-13)[0])


@pytest.mark.parametrize("tau_s", [0.0, 0.15])
@pytest.mark.parametrize("frailty", [0.0, 0.8])
def test_likelihood_equals_the_naive_one(tau_s, frailty):
    table, own = small_tracks()
    grid = {"taus_s": np.array([tau_s]), "frailties": np.array([frailty])}
    found = log_likelihoods(table, own, **grid)[:, 0, 0]
    p = expit(-own)
    first = [(p[0], False, None), (p[1], True, 0.1), (p[2], True, 0.3)]
    second = [(p[3], True, None), (p[4], False, 0.05), (p[5], True, 0.05)]
    third = [(p[6], True, None)]
    expected = [
        naive_log_likelihood(first, tau_s, frailty),
        sum(naive_log_likelihood(rows, tau_s, frailty) for rows in (second, third)),
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert (table.gaps, table.rate_changes) == (1, 1)


def test_intervals_cover_the_memory_that_tracks_were_drawn_with():
    """Of 12 intervals that each cover in 95 %, fewer than 8 do so in one of 10^3 seeds."""
    covered = np.zeros(2, dtype=int)
    for seed in range(12):
        table, own = draw_tracks(
            seed=seed, tau_s=0.2, frailty=0.8, sequences=8, tracks_each=5, frames=20
        )
        fit = fit_memory(table, own)
        assert fit.nats < fit.nats_independent
        covered += [
            low <= true <= high
            for true, (low, high) in ((0.2, fit.tau_interval_s), (0.8, fit.frailty_interval))
        ]
    assert (covered >= 8).all()


def test_independent_tracks_reach_down_to_zero():
    table, own = draw_tracks(seed=5, tau_s=0.0, frailty=0.0, sequences=30)
    fit = fit_memory(table, own, with_frailty=False)
    assert fit.tau_interval_s[0] == 0.0
    assert fit.tau_interval_s[1] < 0.1
    check = check_independence(table, own, fit=fit)
    assert check.p_value > 1e-3  # below in one of 10^3 seeds
    assert check.compatible == (check.p_value >= 0.05)
    # a Poisson count: five standard deviations are passed in fewer than one of 10^6 seeds
    assert abs(check.misses_after_miss - check.expected) < 5.0 * math.sqrt(check.expected)


def test_the_memory_time_does_not_depend_on_the_frame_rate():
    """The same process at 20 Hz, and every second frame of it taken as 10 Hz."""
    table, own = draw_tracks(seed=7, tau_s=0.2, frailty=0.0, sequences=40, frames=40, rate_hz=20.0)
    half = np.flatnonzero(table.frame % 2 == 0)
    who = {"sequence": table.sequence[half], "track": table.track[half]}
    coarse = tracks_of(table.detected[half], **who, frame=table.frame[half] // 2)
    fine = fit_memory(table, own, with_frailty=False)
    rough = fit_memory(coarse, own[half], with_frailty=False)
    assert rough.tau_interval_s[0] < fine.memory.tau_s < rough.tau_interval_s[1]
    assert fine.memory.tau_s == pytest.approx(rough.memory.tau_s, rel=0.15)


def test_runs_and_correlations_equal_the_naive_ones():
    table, own = draw_tracks(seed=11, tau_s=0.3, frailty=0.5, sequences=4, keep=0.9)
    runs, pairs = [], []
    residual = (~table.detected) - expit(-own)
    for track in np.unique(table.track):
        rows = np.flatnonzero(table.track == track)
        length, last = 0, None
        for row in rows:
            joined = last is not None and table.frame[row] == last + 1
            if length and not (joined and not table.detected[row]):
                runs.append(length)
                length = 0
            if not table.detected[row]:
                length += 1
            last = table.frame[row]
        if length:
            runs.append(length)
        pairs += [(a, b) for a in rows for b in rows if table.frame[b] - table.frame[a] == 5]
    expected = np.bincount(np.minimum(runs, 10), minlength=11)[1:]
    np.testing.assert_array_equal(run_lengths(table, table.detected), expected)
    first, second = (residual[list(side)] for side in zip(*pairs, strict=True))
    value = np.mean(first * second) / np.sqrt(np.mean(first**2) * np.mean(second**2))
    found, count = residual_correlation(table, own, table.detected, lag_s=0.5)
    assert count == len(pairs)
    assert found == pytest.approx(value)


def test_drawn_outcomes_follow_the_model():
    """Shares of misses after misses and hits over many draws: 5 standard errors."""
    table, _ = draw_tracks(seed=2, tau_s=0.0, frailty=0.0, sequences=3)
    own = np.full(len(table), logit(0.7))
    rho = float(persistence(0.1, 0.2))
    random = np.random.default_rng(4)
    drawn = sample_outcomes(table, own, law=Memory(tau_s=0.2), samples=300, random=random)
    rows = np.flatnonzero(table.follows)
    before, after = ~drawn[:, rows - 1], ~drawn[:, rows]
    for m, expected in ((True, 0.3 + 0.7 * rho), (False, 0.3 * (1 - rho))):
        chosen = before == m
        share = after[chosen].mean()
        assert abs(share - expected) < 5 * math.sqrt(expected * (1 - expected) / chosen.sum())


def test_samples_drawn_together_are_those_of_outcomes_drawn_one_by_one():
    table, own = draw_tracks(seed=7, tau_s=0.2, frailty=0.5, sequences=3, tracks_each=4, keep=0.8)
    drawn = sample_outcomes(
        table,
        own,
        law=Memory(tau_s=0.2, frailty=0.5),
        samples=3,
        random=np.random.default_rng(9),
    )
    random, normal = np.random.default_rng(9), NormalDist()
    for found in drawn:
        u = random.standard_normal(int(table.track.max()) + 1)
        for row, uniform in enumerate(random.random(len(table))):
            p = normal.inv_cdf(1.0 / (1.0 + math.exp(own[row])))
            p = normal.cdf(p * math.sqrt(1.25) + 0.5 * u[table.track[row]])
            if table.follows[row]:
                p += (float(not found[row - 1]) - p) * math.exp(-table.since_s[row] / 0.2)
            assert found[row] == (uniform < 1.0 - p)


def test_fits_in_processes_are_those_of_one():
    table, _ = draw_tracks(seed=1, tau_s=0.3, frailty=0.0, sequences=6, tracks_each=8)
    whole = partial(fit_pem, model="lr", name="own")
    told = []
    alone = cross_fit(table, model="lr", folds=3)
    shared = cross_fit(
        table, model="lr", folds=3, whole=whole, workers=2, on_progress=lambda *x: told.append(x)
    )
    assert np.array_equal(alone.logit, shared.logit)
    assert alone.whole is None
    assert shared.whole.card.name == "own"
    assert shared.whole.digest == whole(table.obstacles).digest
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_boosted_trees_are_calibrated_by_the_other_parts():
    table, _ = draw_tracks(seed=2, tau_s=0.2, frailty=0.0, sequences=6, tracks_each=8)
    folds = list(GroupKFold(3).split(table.sequence, groups=table.sequence))
    raw = np.empty(len(table))
    for train, held_out in folds:
        part = fit_pem(table.obstacles.take(train), model="gb-raw", calibrate=False)
        raw[held_out] = part.logit(table.obstacles.salient[held_out])

    def loss(line, logit, detected):
        return np.logaddexp(0.0, np.where(detected, -1.0, 1.0) * (line[0] * logit + line[1])).sum()

    found = cross_fit(table, model="gb-raw", folds=3).logit
    for _, held_out in folds:
        others = np.delete(np.arange(len(table)), held_out)
        line = minimize(loss, (1.0, 0.0), args=(raw[others], table.detected[others])).x
        assert line[0] > 0.0
        np.testing.assert_allclose(found[held_out], line[0] * raw[held_out] + line[1], atol=1e-3)


@pytest.mark.parametrize("model", ["guess-mu", "lr", "ml-nn", "gb-raw"])
def test_misses_of_one_sequence_alone_are_refused(model):
    table, _ = draw_tracks(seed=2, tau_s=0.2, frailty=0.0, sequences=6, tracks_each=8)
    alone = table.obstacles.detected | (table.sequence != 0)
    obstacles = replace(table.obstacles, detected=alone)
    with pytest.raises(PemError, match="all that was missed lies in one of 3 parts"):
        cross_fit(replace(table, obstacles=obstacles), model=model, folds=3)
    obstacles = replace(table.obstacles, detected=np.ones_like(alone))
    with pytest.raises(PemError, match="all 960 obstacles were detected"):
        cross_fit(replace(table, obstacles=obstacles), model=model, folds=3)


def test_a_report_holds_what_a_card_shows():
    table, own = draw_tracks(seed=3, tau_s=0.2, frailty=0.0, sequences=10)
    held_out = CrossFitted(own, part=np.zeros(len(table), dtype=np.int64))
    tables = fit_report(table, held_out).tables
    assert tables["groups"][0]["observations"] == len(table)
    assert sum(tables["run_lengths"]) > 0
    lags = [each["lag_s"] for each in tables["correlations"] if each["pairs"]]
    assert lags == [0.1, 0.2, 0.5, 1.0]  # tracks are two seconds long
    assert tables["rate_hz"] == 10.0


def test_closing_speeds_are_those_of_pairs_of_frames_of_a_track():
    """Of 19 pairs that stand still and one that closes 3 m in two tenths of a second."""
    salient = np.zeros((22, len(SALIENT_COLUMNS)))
    salient[:, COLUMN["z_m"]] = [*[20.0] * 20, 80.0, 77.0]
    who = {"sequence": np.zeros(22, int), "track": np.repeat([0, 1], [20, 2])}
    frame = np.array([*range(20), 4, 6])
    tracks = tracks_of(np.ones(22), **who, frame=frame, salient=salient)
    assert closing_speed_mps(tracks) == pytest.approx(np.quantile([*[0.0] * 19, 15.0], 0.95))
    assert closing_speed_mps(replace(tracks, has_state=False)) is None


@pytest.mark.parametrize("memory", [{"tau_s": -0.1}, {"tau_s": math.nan}, {"frailty": 11.0}])
def test_no_memory_out_of_range(memory):
    with pytest.raises(PemError, match="allowed"):
        Memory(**memory)


def test_one_sequence_gives_no_interval():
    table, own = draw_tracks(seed=3, tau_s=0.2, frailty=0.0, sequences=1)
    with pytest.raises(PemError, match="at least two sequences"):
        fit_memory(table, own)


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
    for detected in sample_outcomes(table, own, law=Memory(tau_s=0.1), samples=40, random=random):
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
