"""A visibility of which a part comes and goes, against orthants of normal distributions."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import expit
from scipy.special import logit as logit_of
from scipy.stats import multivariate_normal, norm

from pemviz.errors import PemError
from pemviz.pem.fitting.varying_frailty import (
    fit_varying_frailty,
    held_out_laws,
    likeliest_law,
    sequence_log_likelihoods,
)
from pemviz.pem.judging.memory_report import sample_outcomes
from pemviz.pem.models.memory import Memory, VisibilityNodes, log_sums
from pemviz.pem.models.varying_frailty import (
    NodeGrid,
    VaryingFrailty,
    VaryingNodes,
)
from tests.pem.synthetic_tracks import tracks_of as table_of

LAWS = [
    VaryingFrailty(0.7, 1.2, 0.3),
    VaryingFrailty(0.0, 1.0, 0.5),
    VaryingFrailty(0.3, 2.0, 0.2),
    VaryingFrailty(1.0, 1.0, 0.1),
]
OWN = np.array([2.0, 0.5, -1.0, 3.0, 1.0])
CHAINS = np.array(list(itertools.product((False, True), repeat=OWN.size)))


def sampled_misses(law, logit, *, step_s, random):
    """Whether frames of chains ``[S, T]`` are missed, each chain a track."""
    count, frames = logit.shape
    table = table_of(
        np.ones(logit.size),
        sequence=np.zeros(logit.size),
        track=np.repeat(np.arange(count), frames),
        frame=np.tile(np.arange(frames), count),
        rate_hz=1.0 / step_s,
    )
    outcomes = sample_outcomes(table, logit.ravel(), law=law, samples=1, random=random)
    return ~outcomes.reshape(logit.shape)


def by_orthants(law, own, detected, *, step_s):
    """P(chain) as the probability of an orthant of the latents' normal distribution."""
    times_s = step_s * np.arange(own.size)
    correlation = law.latent_correlation(np.abs(times_s[:, None] - times_s))
    np.fill_diagonal(correlation, 1.0)
    sign = np.where(detected, -1.0, 1.0)
    upper = sign * norm.ppf(expit(-own))
    return multivariate_normal.cdf(upper, cov=correlation * sign[:, None] * sign, maxpts=100_000)


@pytest.mark.parametrize("law", LAWS)
def test_chains_are_orthants_of_a_normal_distribution(law):
    """scipy samples these, to some four digits."""
    found = VaryingNodes(law, 0.1).log_likelihood(np.tile(OWN, (len(CHAINS), 1)), CHAINS)
    known = [by_orthants(law, OWN, chain, step_s=0.1) for chain in CHAINS]
    np.testing.assert_allclose(np.exp(found), known, rtol=2e-3, atol=1e-5)
    assert np.exp(found).sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_pairs_of_frames_have_every_digit_of_two_normals(law):
    """An integral over the first latent, by quadrature."""
    r, (first, second) = law.latent_correlation(np.array(0.1)), norm.ppf(expit(-OWN[:2]))
    both, _ = quad(
        lambda x: norm.pdf(x) * norm.cdf((second - r * x) / np.sqrt(1.0 - r**2)),
        -12.0, first, epsabs=1e-14, epsrel=1e-12,
    )  # fmt: skip
    found = VaryingNodes(law, 0.1).log_likelihood(OWN[None, :2], np.zeros((1, 2), dtype=np.bool_))
    assert np.exp(found[0]) == pytest.approx(both, rel=1e-8)


@given(
    frailty=st.just(0.0) | st.floats(0.02, 2.0), varying=st.floats(0.1, 3.0),
    varying_s=st.floats(0.05, 2.0), own=st.floats(-6.0, 12.0), step_s=st.floats(0.05, 0.5),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_a_frame_alone_is_missed_as_often_as_the_model_says(
    frailty, varying, varying_s, own, step_s
):
    """At every frame, whatever the time: w is stationary."""
    nodes = VaryingNodes(VaryingFrailty(frailty, varying, varying_s), step_s)
    shares = nodes.begun(1)
    for _ in range(3):
        hit, miss = (nodes.log_outcomes(np.array([own]), np.array([one])) for one in (False, True))
        logit, mean = nodes.logit_and_mean(shares, hit, miss)
        assert logit[0] == pytest.approx(own, abs=2e-6 * max(1.0, abs(own)))
        assert mean[0] == pytest.approx(0.0, abs=1e-6)
        shares = nodes.later(shares, nodes.moved_on(step_s))


def test_what_hardly_varies_is_the_frailty_of_old():
    law, random = VaryingFrailty(0.8, 0.01, 1.0), np.random.default_rng(1)
    own, detected = random.normal(1.0, 1.0, (20, 30)), random.random((20, 30)) < 0.7
    nodes = VisibilityNodes(0.8)
    log_joint = np.tile(nodes.log_weight, (20, 1))
    for step in range(30):
        miss, hit = nodes.log_outcomes(own[:, step])
        log_joint += np.where(detected[:, step, None], hit, miss)
    found = VaryingNodes(law, 0.1).log_likelihood(own, detected)
    np.testing.assert_allclose(found, log_sums(log_joint), atol=0.01)


def test_a_finer_grid_says_the_same_of_long_chains():
    random = np.random.default_rng(2)
    for law in LAWS:
        own = np.tile(np.linspace(0.0, 4.0, 60), (16, 1))
        missed = sampled_misses(law, own, step_s=0.1, random=random)
        usual, finer = (
            VaryingNodes(law, 0.1, grid).log_likelihood(own, ~missed)
            for grid in (NodeGrid(), NodeGrid(farthest=10.0, of_lasting=0.12, of_varying=0.3))
        )
        np.testing.assert_allclose(usual, finer, atol=1e-5)


def test_rollouts_do_not_depend_on_those_beside():
    law, random = LAWS[0], np.random.default_rng(3)
    own, detected = random.normal(2.0, 1.0, (70, 12)), random.random((70, 12)) < 0.8
    nodes = VaryingNodes(law, 0.05)
    every = nodes.log_likelihood(own, detected)
    for rows in (slice(0, 1), slice(5, 38), slice(60, 70)):
        np.testing.assert_array_equal(nodes.log_likelihood(own[rows], detected[rows]), every[rows])


def test_samples_have_the_laws_pairs():
    """Shares of pairs of misses over 200,000 chains; five standard errors, a false alarm in 1e6."""
    law, count = VaryingFrailty(0.5, 1.5, 0.2), 200_000
    own = np.array([1.0, 0.0, 2.0])
    missed = sampled_misses(
        law, np.tile(own, (count, 1)), step_s=0.1, random=np.random.default_rng(4)
    )
    np.testing.assert_allclose(missed.mean(axis=0), expit(-own), atol=5 * 0.5 / count**0.5)
    for one, other in ((0, 1), (0, 2), (1, 2)):
        r = law.latent_correlation(np.array([0.1 * (other - one)]))[0]
        known = multivariate_normal.cdf(
            norm.ppf(expit(-own[[one, other]])), cov=[[1.0, r], [r, 1.0]]
        )
        both = (missed[:, one] & missed[:, other]).mean()
        assert abs(both - known) < 5 * (known * (1 - known) / count) ** 0.5


def tracks_of(law, *, tracks, frames, seed):
    """Tracks at 10 Hz whose P(missed) is known, with outcomes of the law; 20 in a sequence."""
    random = np.random.default_rng(seed)
    own = np.tile(np.linspace(-1.0, 3.0, frames), (tracks, 1))
    missed = sampled_misses(law, own, step_s=0.1, random=random)
    track = np.repeat(np.arange(tracks), frames)
    table = table_of(
        ~missed.ravel(), sequence=track // 20, track=track, frame=np.tile(np.arange(frames), tracks)
    )
    return table, own.ravel()


def test_the_likelihood_of_sequences_is_the_sum_of_their_tracks():
    law = LAWS[0]
    tracks, own = tracks_of(law, tracks=60, frames=8, seed=5)
    found = sequence_log_likelihoods(tracks, own, law)
    known = VaryingNodes(law, 0.1).log_likelihood(
        own.reshape(60, 8), tracks.detected.reshape(60, 8)
    )
    np.testing.assert_allclose(found, known.reshape(3, 20).sum(axis=1), atol=2e-3)


def test_gaps_in_a_track_let_the_visibility_move_on():
    law = VaryingFrailty(0.0, 2.0, 0.2)
    tracks, own = tracks_of(law, tracks=40, frames=6, seed=6)
    frames = np.tile([0, 1, 2, 7, 8, 9], 40)
    gapped = replace(tracks, frame=frames)
    found = sequence_log_likelihoods(gapped, own, law)
    nodes, known = VaryingNodes(law, 0.1), []
    for chain, logit in zip(tracks.detected.reshape(40, 6), own.reshape(40, 6), strict=True):
        shares, total = nodes.begun(1), 0.0
        for place, (hit, one) in enumerate(zip(chain, logit, strict=True)):
            if place:
                shares = nodes.later(shares, nodes.moved_on(0.5 if place == 3 else 0.1))
            log_p = nodes.log_outcomes(np.array([one]), np.array([not hit]))
            shares, told = nodes.after(shares, log_p)
            total += float(told[0])
        known.append(total)
    np.testing.assert_allclose(found, np.reshape(known, (2, 20)).sum(axis=1), atol=2e-3)


def test_a_law_is_found_again_and_told_from_copies():
    """150 tracks of one law: its correlations within 0.12, and likelier than copies."""
    law = VaryingFrailty(0.6, 1.5, 0.3)
    tracks, own = tracks_of(law, tracks=150, frames=25, seed=7)
    fit = fit_varying_frailty(tracks, own, memory=Memory(tau_s=0.15, frailty=0.5))
    lags_s = np.array([0.1, 0.3, 1.0, 2.5])
    found, known = fit.law.latent_correlation(lags_s), law.latent_correlation(lags_s)
    np.testing.assert_allclose(found, known, atol=0.12)
    assert fit.better_by > 2 * fit.better_by_std_error > 0.0
    at_the_law = -sequence_log_likelihoods(tracks, own, law).sum() / len(tracks)
    assert fit.nats < at_the_law + 1e-4


@pytest.mark.parametrize(("tracks", "seed"), [(40, 8), (60, 9), (60, 20)])
def test_no_law_nearby_is_much_likelier_than_the_one_found(tracks, seed):
    """Flat likelihoods, on which a search by slopes stopped near nothing; a hundred others."""
    table, own = tracks_of(LAWS[0], tracks=tracks, frames=10, seed=seed)
    found = likeliest_law(table, own)
    best = sequence_log_likelihoods(table, own, found).sum()
    random = np.random.default_rng(seed)
    for _ in range(100):
        frailty, varying, varying_s = np.exp(random.normal(0.0, 0.8, 3)) * (0.7, 1.0, 0.4)
        other = VaryingFrailty(
            min(max(frailty, 0.02), 4.0), min(varying, 5.0), min(max(varying_s, 0.02), 8.0)
        )
        assert sequence_log_likelihoods(table, own, other).sum() < best + 0.1


def test_parts_of_the_sequences_have_laws_of_the_others():
    tracks, own = tracks_of(LAWS[0], tracks=60, frames=10, seed=8)
    part, told, start = tracks.sequence % 2, [], VaryingFrailty(0.0, 2.0, 0.5)
    laws = held_out_laws(
        tracks, own, part=part, start=start,
        on_progress=lambda done, of_all: told.append((done, of_all)),
    )  # fmt: skip
    others = [(tracks.only(rows), own[rows]) for rows in (part != 0, part != 1)]
    assert laws == tuple(likeliest_law(*other, start=start) for other in others)
    assert laws[0] != laws[1]
    assert told == [(1, 2), (2, 2)]
    for other, law in zip(others, laws, strict=True):
        ends = [sequence_log_likelihoods(*other, one).sum() for one in (law, likeliest_law(*other))]
        assert ends[1] == pytest.approx(ends[0], abs=0.1)  # wherever the search begins


def test_parts_without_a_track_of_two_frames_are_refused():
    tracks, own = tracks_of(LAWS[0], tracks=40, frames=4, seed=9)
    rows = (tracks.sequence == 0) | (tracks.frame == 0)
    with pytest.raises(
        PemError, match="no obstacle is seen twice without part 1 of 2: fewer folds"
    ):
        held_out_laws(tracks.only(rows), own[rows], part=tracks.sequence[rows], start=LAWS[0])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((-0.1, 1.0, 0.5), "frailty is -0.1, allowed: 0, or 0.02 to 5"),
        ((1e-9, 1.0, 0.5), "frailty is 1e-09, allowed: 0, or 0.02 to 5"),
        ((0.0, 0.0, 0.5), "varying_frailty is 0, allowed: 0.01 to 5"),
        ((0.0, 1.0, 0.0), "varying_frailty_s is 0, allowed: 0.01 to 10 s"),
        ((0.0, float("nan"), 0.5), "varying_frailty is nan"),
        ((5.0, 1e-150, 0.5), "varying_frailty is 1e-150, allowed: 0.01 to 5"),
    ],
)
def test_laws_out_of_range_are_refused_in_one_line(values, words):
    with pytest.raises(PemError, match=words):
        VaryingFrailty(*values)


def test_an_impossible_outcome_is_no_error():
    """A model that is as good as certain, contradicted for a second."""
    own = np.full((2, 20), float(logit_of(1.0 - 1e-14)))
    found = VaryingNodes(LAWS[0], 0.1).log_likelihood(own, np.zeros((2, 20), dtype=np.bool_))
    assert np.isfinite(found).all()
    assert (found < -20.0).all()
