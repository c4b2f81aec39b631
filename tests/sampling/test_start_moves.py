"""Means and spreads of the latents at the start: densities, draws, and what a fit without one is.

Each statistical test fails by chance with a probability of 1e-6 at most; their seeds are fixed.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from pemviz.latents import LatentCounts
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.start_moves import StartMoves, even_normals, fit_start, start_optimism
from pemviz.sampling.rollouts.simulate import ChoosesStart, LatentTrack, NormalSource

AXES = np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0], [0.8, -0.6, 0.0]])
MOVES = StartMoves(np.array([2.5, -0.5, 0.0]), np.ones(3), AXES, np.array([0.3, 0.7, 1.4]))
STRETCHED = replace(MOVES, sd=np.array([0.4, 1.0, 0.7]), axes=AXES[:1], along=np.array([0.5]))


def covariance(moves):
    """Of the narrow half."""
    root = np.eye(moves.mean.size)
    for axis, along in zip(moves.axes, moves.along, strict=True):
        root += (along - 1.0) * np.outer(axis, axis)
    root = moves.sd[:, None] * root
    return root @ root.T


def mixture_pdf(start, moves):
    """Half with the spreads, half with the model's."""
    narrow = stats.multivariate_normal.pdf(start, moves.mean, covariance(moves))
    return 0.5 * narrow + 0.5 * stats.norm.pdf(start, moves.mean).prod(axis=1)


def by_latent(mean, sd):
    """Moves of latents that are independent of each other."""
    none = StartMoves.unmoved(mean.size)
    return replace(none, mean=mean, sd=sd)


@dataclass(frozen=True)
class Moved(PemProposal):
    """A proposal that moves starts alone."""

    moves: StartMoves

    def chosen_start(self, normals):
        narrow = np.random.default_rng(4).random(len(normals)) < 0.5
        start = self.moves.starts(normals, narrow)
        return start, -self.moves.log_ratio(start)


def drawn(count, *, moves=MOVES):
    counts = LatentCounts(start=moves.mean.size)
    source = NormalSource(np.random.SeedSequence(3), counts=counts, steps=2)
    proposal = Moved(moves)
    assert isinstance(proposal, ChoosesStart)
    return LatentTrack.begun(source.draw(count), proposal, outcomes=2).latents


@pytest.mark.parametrize("moves", [MOVES, STRETCHED, by_latent(MOVES.mean, STRETCHED.sd)])
def test_log_ratio_is_that_of_the_densities(moves):
    start = 2.0 * np.random.default_rng(0).standard_normal((50, 3))
    expected = np.log(mixture_pdf(start, moves)) - stats.norm.logpdf(start).sum(axis=1)
    np.testing.assert_allclose(moves.log_ratio(start), expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(StartMoves.unmoved(3).log_ratio(start), 0.0)


@pytest.mark.parametrize("moves", [MOVES, STRETCHED])
def test_starts_are_drawn_from_the_density_that_weighs_them(moves):
    """Kolmogorov and Smirnov's test along ten directions; weights as the density says."""
    latents = drawn(20_000, moves=moves)
    assert latents is not None
    spread = covariance(moves)
    for direction in np.random.default_rng(1).normal(size=(10, 3)):
        mean, wide = direction @ moves.mean, np.linalg.norm(direction)
        narrow = np.sqrt(direction @ spread @ direction)

        def cdf(z, mean=mean, narrow=narrow, wide=wide):
            return 0.5 * stats.norm.cdf(z, mean, narrow) + 0.5 * stats.norm.cdf(z, mean, wide)

        assert stats.kstest(latents.start @ direction, cdf).pvalue > 5e-8
    expected = stats.norm.logpdf(latents.start).sum(axis=1)
    expected -= np.log(mixture_pdf(latents.start, moves))
    np.testing.assert_allclose(latents.log_weight, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("moves", [MOVES, STRETCHED, replace(MOVES, axes=-AXES)])
def test_normals_are_turned_to_the_first_axis(moves):
    """Lengths and angles stay, and the first of them is what lies along it, up to the sign."""
    normals = np.random.default_rng(2).standard_normal((6, 3))
    turned = moves.turned(normals)
    np.testing.assert_allclose(turned @ turned.T, normals @ normals.T, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.abs(turned @ moves.axes[0]), np.abs(normals[:, 0]), rtol=1e-12)
    np.testing.assert_array_equal(StartMoves.unmoved(3).turned(normals), normals)


def test_even_normals_are_normal_and_more_even_than_random_ones():
    """Of 200 calls: each point has the normal's law, and averages vary far less, unbiased.

    The share of independent points beyond a plane would vary as a binomial one does; theirs, by
    less than half of that.
    """
    generator = np.random.default_rng(9)
    calls = np.array([even_normals(300, 3, generator) for _ in range(200)])
    assert stats.kstest(calls[:, 17, 1], "norm").pvalue > 1e-7
    assert stats.kstest(calls[:, 0, 2], "norm").pvalue > 1e-7
    assert np.isfinite(even_normals(100_000, 2, generator)).all()
    assert even_normals(0, 3, generator).shape == (0, 3)
    beyond = (calls.sum(axis=2) / np.sqrt(3.0) > 1.0).mean(axis=1)
    share = stats.norm.sf(1.0)
    assert beyond.mean() == pytest.approx(share, abs=5.0 * beyond.std() / np.sqrt(200))
    assert beyond.std() < 0.5 * np.sqrt(share * (1.0 - share) / 300)


def test_no_two_latents_have_like_signs_in_few_even_normals():
    """Sixteen points of the sequence itself are alike in some pairs of coordinates, in every set.

    Of independent ones the mean square of how alike two latents are is 1/16; of 300 sets' the worst
    of 190 pairs would be above 6/16, where 1.8/16 is expected, by more than ten standard errors.
    """
    generator = np.random.default_rng(4)
    signs = [np.sign(even_normals(16, 20, generator)) for _ in range(300)]
    alike = np.mean([(sign.T @ sign / 16.0) ** 2 for sign in signs], axis=0)
    assert (alike - np.eye(20)).max() < 6.0 / 16.0


def test_starts_do_not_depend_on_how_many_are_drawn_at_a_time():
    counts = LatentCounts(start=3, noise=1)
    at_once = NormalSource(np.random.SeedSequence(3), counts=counts, steps=2)
    one_by_one = NormalSource(np.random.SeedSequence(3), counts=counts, steps=2)
    together = at_once.draw(4)
    for row in range(4):
        alone = one_by_one.draw(1)
        assert alone is not None
        assert together is not None
        for name in ("start", "noise", "choice"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(together, name)[[row]])


def test_what_a_fit_without_a_start_takes_from_it_is_that_of_a_second_fit():
    generator = np.random.default_rng(5)
    start = 0.3 * generator.standard_normal((12, 2)) + [2.0, 0.5]
    weight = generator.uniform(0.1, 3.0, size=12)
    moves = fit_start(start, weight, ridge=0.01)
    found = start_optimism(moves, start, weight, ridge=0.01)
    for place in range(12):
        others = np.delete(np.arange(12), place)
        without = fit_start(start[others], weight[others], ridge=0.01)
        both = [float(one.log_ratio(start[[place]])[0]) for one in (moves, without)]
        assert found[place] == pytest.approx(max(both[0] - both[1], 0.0), rel=1e-9, abs=1e-12)


def test_known_moves_are_found_again():
    """Within five standard errors; the model's spread counts as five starts."""
    generator = np.random.default_rng(6)
    axes = AXES[::2, :2]
    start = (generator.standard_normal((4000, 2)) * [0.4, 0.8]) @ axes + [3.0, -1.0]
    moves = fit_start(start, np.ones(4000), ridge=0.01)
    assert moves.mean == pytest.approx([3.0, -1.0], abs=5.0 * 0.8 / np.sqrt(4000))
    assert moves.sd == pytest.approx([1.0, 1.0], abs=0.0)
    assert moves.along == pytest.approx([0.4, 0.8], abs=0.05)
    assert np.abs(moves.axes @ axes.T) == pytest.approx(np.eye(2), abs=0.1)


def test_of_many_latents_the_spread_along_the_mean_is_found():
    """In 30 dimensions beyond a plane: that of what is left of a normal beyond 3 along, 1 across.

    A spread of 0.28 from 2,000 starts, beside which five of the model count, within 0.02.
    """
    start = beyond_plane(2_000, 30, 3.0, np.random.default_rng(10))
    moves = fit_start(start, np.ones(2_000), ridge=0.01)
    towards = np.ones(30) / np.sqrt(30.0)
    assert moves.axes[0] @ towards > 0.99
    spread = covariance(moves)
    expected = stats.truncnorm(3.0, np.inf).std()
    assert np.sqrt(towards @ spread @ towards) == pytest.approx(expected, abs=0.02)
    across = np.eye(30)[0] - np.eye(30)[1]
    assert np.sqrt(across @ spread @ across / 2.0) == pytest.approx(1.0, abs=0.05)


def test_spreads_stay_between_a_fifth_and_three():
    alike = fit_start(np.full((500, 1), 4.0), np.ones(500), ridge=0.01)
    apart = fit_start(np.array([[-6.0], [6.0]] * 50), np.ones(100), ridge=0.01)
    assert alike.along == pytest.approx([0.2])
    assert apart.along == pytest.approx([3.0])


def beyond_plane(count, dimension, limit, generator):
    """Standard normals of which the sum over sqrt(dimension) is above ``limit``."""
    start = generator.standard_normal((count, dimension))
    along = stats.norm.isf(generator.random(count) * stats.norm.sf(limit))
    across = start.mean(axis=1, keepdims=True)
    return start - across + along[:, None] / np.sqrt(dimension)


def test_moves_in_many_dimensions_are_learned_from_fewer_starts_than_dimensions():
    """A plane 4.5 away in 100 dimensions, learned from 50 starts.

    Weighed draws of q have the second moment mu E[p / q | violates]. If q moves the mean by m
    towards the plane, exactly, it is exp(m^2) Phi(-4.5 - m), about 6 mu^2. Moved by each latent's
    own mean, with its own spread, it is about 50.
    """
    generator = np.random.default_rng(7)
    start = beyond_plane(50, 100, 4.5, generator)
    moves = fit_start(start, np.ones(50), ridge=0.01)
    others = beyond_plane(5000, 100, 4.5, generator)
    mean = stats.norm.pdf(4.5) / stats.norm.sf(4.5)
    exactly = np.exp(mean**2) * stats.norm.sf(4.5 + mean) / stats.norm.sf(4.5)
    assert np.exp(-moves.log_ratio(others)).mean() < 1.5 * exactly


def test_families_of_neighbours_count_as_few():
    """Three families of 60 each beyond a plane, as chains leave them: 180 starts tell as 3 do.

    What is lacking from how likely others beyond it are is what a proposal would be off by [nats].
    """
    generator = np.random.default_rng(8)
    heads = beyond_plane(3, 100, 5.0, generator)
    start = np.repeat(heads, 60, axis=0) + 0.1 * generator.standard_normal((180, 100))
    others = beyond_plane(2_000, 100, 5.0, generator)
    taken_as = [
        fit_start(start, np.ones(180), ridge=0.01, independent=share) for share in (1.0, 3 / 180)
    ]
    alike, few = (moves.log_ratio(others).mean() for moves in taken_as)
    best = 0.5 * 5.0**2
    assert alike < best - 10.0
    assert few > best - 1.0


def test_what_a_fit_takes_from_its_starts_is_what_others_lack():
    """Means over 20 fits in 30 dimensions, of log likelihoods, within five standard errors."""
    generator = np.random.default_rng(8)
    taken, lacked = list[float](), list[float]()
    for _ in range(20):
        start = beyond_plane(60, 30, 4.0, generator)
        moves = fit_start(start, np.ones(60), ridge=0.01)
        others = moves.log_ratio(beyond_plane(2000, 30, 4.0, generator)).mean()
        lacked.append(moves.log_ratio(start).mean() - others)
        taken.append(start_optimism(moves, start, np.ones(60), ridge=0.01).mean())
    error = np.std(np.subtract(taken, lacked)) / np.sqrt(20)
    assert np.mean(taken) == pytest.approx(np.mean(lacked), abs=5.0 * error)
