"""How a proposal moves the latents at the start, and what it is fitted to.

A violation may need a start that is rare by itself, and the starts that it needs lie closer to each
other than those of the model do. With z and m vectors,

    q(z) = (N(z; m, 1) + N(z; m, V)) / 2

so that half keeps the model's own spread, and no weight grows without bound where V is too small.

Of few latents V is a full matrix: beyond a plane violations lie close to it, in whichever direction
that is, and far apart along it. Of many, whose V would be learned from fewer violations than it has
entries, each has a spread of its own, and there is one more along the mean (El Masri, Morio,
Simatos 2021: what the cross-entropy method needs in many dimensions), and means and spreads are
drawn together (:mod:`pemviz.proposals.shrinkage`). Where violations lie on all sides spreads are
above 1.

Points that fill space more evenly than random ones do tell an average more exactly. So those of a
fitted proposal are of a scrambled Sobol' sequence (Matousek 1998): each is distributed as a random
one would be, averages are unbiased, and the first coordinate, which is spread most evenly, runs
along the direction in which V is narrowest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.special import ndtri

from pemviz.arrays import BoolArray, FloatArray
from pemviz.latents import log_shifted
from pemviz.proposals.shrinkage import FEWEST, Shrinkage, shrinkage

SPREAD_RIDGE = 5.0
"""So many starts of spread 1 count beside those that a spread is fitted to."""
LEAST_SPREAD, LARGEST_SPREAD = 0.2, 3.0
NARROW_SHARE = 0.5
"""Of the starts, which is that of the others too."""
IN_PLACE = 2
"""Coordinates of the points that are most even: which spread a start has, and the first axis."""
SOBOL_BITS = 30
"""Of a point's coordinates; what is below is random."""


@dataclass(frozen=True, eq=False)
class StartMoves:
    """Means and spreads of S latents at the start.

    V is A A', where A = diag(sd) (1 + sum_k (along_k - 1) axes_k axes_k').

    Attributes:
        mean: ``[S]``; of N rollouts each its own, ``[N, S]``.
        sd: Spreads of half of the rollouts, likewise; 1 is that of the model.
        axes: Directions with a spread of their own, of length 1 and at right angles, or 0,
            ``[K, S]`` or ``[N, K, S]``; the first is the one that matters most.
        along: That spread, in multiples of ``sd``, ``[K]`` or ``[N, K]``.
    """

    mean: FloatArray
    sd: FloatArray
    axes: FloatArray
    along: FloatArray

    @staticmethod
    def unmoved(latents: int) -> "StartMoves":
        """Those of the model, for so many latents."""
        axes = latents if latents < FEWEST else 1
        return StartMoves(
            np.zeros(latents), np.ones(latents), np.zeros((axes, latents)), np.ones(axes)
        )

    @staticmethod
    def stacked(each: Sequence["StartMoves"]) -> "StartMoves":
        """Of N rollouts, of each its own, for as many latents."""
        places = (np.stack([getattr(one, field.name) for one in each]) for field in fields(each[0]))
        return StartMoves(*places)

    def rows(self, rows: slice) -> "StartMoves":
        """Of some of the rollouts."""
        return StartMoves(self.mean[rows], self.sd[rows], self.axes[rows], self.along[rows])

    def log_ratio(self, start: FloatArray) -> FloatArray:
        """Log q / p of starts ``[N, S]``, ``[N]`` [nats]."""
        start = np.ascontiguousarray(start)
        wide, off = log_shifted(start, self.mean), (start - self.mean) / self.sd
        along = self._along_axes(off)
        squares = np.sum(off**2, axis=-1) + np.sum((along / self.along) ** 2 - along**2, axis=-1)
        volume = np.sum(np.log(self.sd), axis=-1) + np.sum(np.log(self.along), axis=-1)
        narrow = 0.5 * np.sum(start**2, axis=-1) - 0.5 * squares - volume
        as_wide = np.all(self.sd == 1.0, axis=-1) & np.all(self.along == 1.0, axis=-1)
        return np.where(as_wide, wide, np.logaddexp(wide, narrow) + np.log(NARROW_SHARE))

    def starts(self, normals: FloatArray, narrow: BoolArray) -> FloatArray:
        """Made of independent standard normals ``[N, S]``; which are ``narrow`` is ``[N]``."""
        along = (self.along - 1.0) * self._along_axes(normals)
        closer = self.sd * (normals + np.sum(along[..., None] * self.axes, axis=-2))
        return np.where(narrow[:, None], closer, normals) + self.mean

    def turned(self, normals: FloatArray) -> FloatArray:
        """Standard normals ``[N, S]`` mirrored so that the first runs along the first axis."""
        if not normals.size:
            return normals
        axis = self.axes[..., 0, :]
        axis = np.where(axis[..., :1] > 0.0, -axis, axis)  # far from the first coordinate
        across = -axis
        across[..., 0] += 1.0
        share = np.sum(across * normals, axis=-1) / across[..., 0]
        found = normals - share[..., None] * across
        return np.where(np.any(axis, axis=-1)[..., None], found, normals)

    def _along_axes(self, values: FloatArray) -> FloatArray:
        """Components ``[N, K]`` of values ``[N, S]``, a row's the same in any batch."""
        return np.sum(np.ascontiguousarray(self.axes * values[:, None, :]), axis=-1)


def even_normals(count: int, latents: int, generator: np.random.Generator) -> FloatArray:
    """Standard normals ``[count, latents]`` of points that fill space evenly, in random order.

    Each is distributed as a random one would be, and independent of those of other calls. The first
    two latents are spread most evenly. Of more latents than the sequence has coordinates all are
    random.
    """
    from scipy.stats import qmc  # noqa: PLC0415  slow to import

    if not count or latents > qmc.Sobol.MAXDIM:
        return generator.standard_normal((count, latents))
    sequence = qmc.Sobol(latents, scramble=True, bits=SOBOL_BITS, rng=generator)
    # the first by itself: of others than powers of two it warns that they are less even
    points = np.concatenate([sequence.random(1), sequence.random(count - 1)])
    points = generator.permutation(points)
    # few points are alike in some pairs of later coordinates: not in the same latents' each time
    points[:, IN_PLACE:] = generator.permutation(points[:, IN_PLACE:], axis=1)
    points += (1.0 - generator.random(points.shape)) * 2.0**-SOBOL_BITS
    return ndtri(np.minimum(points, 1.0 - np.finfo(float).epsneg))


def fit_start(
    start: FloatArray, weight: FloatArray, *, ridge: float, independent: float = 1.0
) -> StartMoves:
    """The moves nearest to starts ``[N, S]`` of weights ``[N]``, not negative.

    So many starts at 0 as ``ridge`` says, above 0, count beside those that means are fitted to.
    As errors of means and spreads, those of ``independent`` times as many starts are taken: of
    chains' starts, a few families of neighbours, most are much like others.
    """
    sums = _Sums.of(start, weight)
    return _fitted(sums, _Common.of(sums, ridge=ridge, independent=independent))


def start_optimism(
    moves: StartMoves,
    start: FloatArray,
    weight: FloatArray,
    *,
    ridge: float,
    independent: float = 1.0,
) -> FloatArray:
    """By how much each start is likelier than if the fit had been made without it, ``[N]`` [nats].

    ``moves`` are those fitted by :func:`fit_start` with the other arguments.
    """
    sums = _Sums.of(start, weight)
    common = _Common.of(sums, ridge=ridge, independent=independent)
    without = _fitted(sums.without_each(start, weight), common)
    return (moves.log_ratio(start) - without.log_ratio(start)).clip(0.0)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Of weighted starts; or of N times all but one, ``[N, ...]``.

    Attributes:
        weights: Their sum, ``[]`` or ``[N]``.
        starts: ``[S]`` or ``[N, S]``.
        products: Of each two latents of all starts, ``[S, S]``.
        left_out: The start that is not counted times the root of its weight, ``[N, S]``; 0 where
            all are.
    """

    weights: FloatArray
    starts: FloatArray
    products: FloatArray
    left_out: FloatArray

    @staticmethod
    def of(start: FloatArray, weight: FloatArray) -> "_Sums":
        """All of them."""
        products = (start.T * weight) @ start
        return _Sums(weight.sum(), weight @ start, products, np.zeros(start.shape[1]))

    def without_each(self, start: FloatArray, weight: FloatArray) -> "_Sums":
        """All but one, for each one."""
        own = weight[:, None]
        left = (self.weights - weight).clip(0.0)
        return _Sums(left, self.starts - own * start, self.products, np.sqrt(own) * start)

    def squares(self, mean: FloatArray) -> FloatArray:
        """Of distances from a mean, of each latent."""
        own = np.diagonal(self.products) - self.left_out**2
        found = own - 2.0 * mean * self.starts + self.weights[..., None] * mean**2
        return np.maximum(found, 0.0)

    def squares_along(self, direction: FloatArray, mean: FloatArray) -> FloatArray:
        """Of distances from a mean along a direction, ``[]`` or ``[N]``."""
        of_all = np.sum((direction @ self.products) * direction, axis=-1)
        own, starts, at = (
            np.sum(direction * one, axis=-1) for one in (self.left_out, self.starts, mean)
        )
        return np.maximum(of_all - own**2 - 2.0 * at * starts + self.weights * at**2, 0.0)

    def products_around(self, mean: FloatArray) -> FloatArray:
        """Of distances of each two latents from a mean, ``[S, S]`` or ``[N, S, S]``."""
        both = mean[..., :, None] * self.starts[..., None, :]
        own = self.left_out[..., :, None] * self.left_out[..., None, :]
        square = mean[..., :, None] * mean[..., None, :]
        found = self.products - own - both - np.swapaxes(both, -1, -2)
        return found + self.weights[..., None, None] * square


@dataclass(frozen=True)
class _Common:
    """How means and logs of spreads are drawn together.

    Attributes:
        ridge: As :func:`fit_start` has it.
        independent: Likewise.
        means: Of means.
        spreads: Of logs of spreads.
    """

    ridge: float
    independent: float
    means: Shrinkage
    spreads: Shrinkage

    @staticmethod
    def of(sums: _Sums, *, ridge: float, independent: float) -> "_Common":
        """As all starts have it."""
        known = independent * sums.weights
        mean = sums.starts / (sums.weights + ridge)
        spread = _spread(sums.squares(mean), sums.weights[..., None])
        if independent < 1.0:
            spread = np.maximum(spread, 1.0)  # neighbours do not show how far families are apart
        means = shrinkage(mean, spread**2 / (known + ridge))
        log_spread = np.log(_spread(sums.squares(means.of(mean)), sums.weights[..., None]))
        error = np.full(mean.size, 0.5 / (known + SPREAD_RIDGE))
        return _Common(ridge, independent, means, shrinkage(log_spread, error))


def _fitted(sums: _Sums, common: _Common) -> StartMoves:
    """The moves nearest to the starts."""
    weights = sums.weights[..., None]
    mean = common.means.of(sums.starts / (weights + common.ridge))
    known, latents = common.independent * weights, mean.shape[-1]
    if latents < FEWEST:
        spread_out = common.independent * sums.products_around(mean)
        variance = spread_out + SPREAD_RIDGE * np.eye(latents)
        values, axes = np.linalg.eigh(variance / (known[..., None] + SPREAD_RIDGE))
        along = np.sqrt(values).clip(LEAST_SPREAD, LARGEST_SPREAD)
        return StartMoves(mean, np.ones(mean.shape), np.swapaxes(axes, -1, -2), along)
    sd = np.exp(common.spreads.of(np.log(_spread(sums.squares(mean), weights))))
    towards = mean / sd
    length = np.sqrt(np.sum(towards**2, axis=-1, keepdims=True))
    axis = np.divide(towards, length, out=np.zeros(towards.shape), where=length > 0.0)
    squares = common.independent * sums.squares_along(axis / sd, mean)
    along = np.where(length > 0.0, _spread(squares[..., None], known), 1.0)
    return StartMoves(mean, sd, axis[..., None, :], along)


def _spread(squares: FloatArray, weights: FloatArray) -> FloatArray:
    """From sums of weighted squares and of the weights."""
    variance = (squares + SPREAD_RIDGE) / (weights + SPREAD_RIDGE)
    return np.sqrt(variance).clip(LEAST_SPREAD, LARGEST_SPREAD)
