"""A memory of another kind: a visibility that drifts, in place of outcomes that are copied.

pemviz's memory copies the outcome before with probability rho = exp(-h / tau) and draws anew
otherwise. In a constant state P(missed) then stays p. Where p falls from nearly 1 to nearly 0
within a few frames, as when a car comes near, copies of misses outlive it: P(missed) is late by
about tau. A detector without memory does nothing of the kind.

Here each obstacle has a latent normal

    x_t = (f u + g w_t + e_t) / sqrt(1 + f^2 + g^2),   missed at t if x_t < Phi^-1(p_t),

with u standard normal for as long as it is there (frailty f), w_t a stationary standard
Ornstein-Uhlenbeck process with time tau (what changes slowly: the place in the pixel grid, drops,
the background) and e_t white. P(missed) is p_t in every frame, however fast the state changes; two
frames have the latent correlation r(h) = (f^2 + g^2 exp(-h / tau)) / (1 + f^2 + g^2).

Fitted by pairs of frames of a track (composite likelihood; Lindsay 1988, Contemporary Mathematics
80:221): r for each of several lags by maximum likelihood, then f, g and tau through these.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.special import ndtr

from pemviz.arrays import BoolArray, FloatArray
from pemviz.pem.data.table import TrackTable
from pemviz.pem.models.memory import miss_quantile
from pemviz.pem.models.protocol import Pem
from studies.detector_in_the_loop.drives import DT_S
from studies.detector_in_the_loop.worlds import World

LAGS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 45)
CORRELATIONS = np.linspace(0.0, 0.985, 67)
FEWEST_PAIRS = 200
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
AT_A_TIME = 20_000


@dataclass(frozen=True)
class Drifting:
    """How visible obstacles are.

    Attributes:
        frailty: f, what lasts.
        drift: g, what changes slowly.
        tau_s: With this time [s].
    """

    frailty: float
    drift: float
    tau_s: float

    def correlation(self, lag_s: FloatArray) -> FloatArray:
        """Of latents so far apart, above 0 [s]."""
        slow = self.drift**2 * np.exp(-lag_s / self.tau_s)
        return (self.frailty**2 + slow) / (1.0 + self.frailty**2 + self.drift**2)


def both_below(first: FloatArray, second: FloatArray, correlation: FloatArray) -> FloatArray:
    """P(X < first, Y < second) of standard normals, by Plackett's identity.

    ``first`` and ``second`` are ``[N]``, ``correlation`` ``[R]``; gives ``[R, N]``. Gauss-Legendre
    in the angle whose sine the correlation is (Drezner & Wesolowsky 1990, J. Stat. Comput. Simul.
    35:101).
    """
    independent = ndtr(first) * ndtr(second)
    found = np.empty((correlation.size, first.size))
    squares, product = first**2 + second**2, 2.0 * first * second
    for place, r in enumerate(correlation):
        top = float(np.arcsin(r))
        angle = 0.5 * top * (NODES + 1.0)
        sine, cosine = np.sin(angle), np.cos(angle)
        power = -(squares[:, None] - product[:, None] * sine) / (2.0 * cosine**2)
        found[place] = independent + (np.exp(power) @ WEIGHTS) * top / (4.0 * np.pi)
    return found


def pair_log_likelihood(
    quantile: tuple[FloatArray, FloatArray], missed: tuple[BoolArray, BoolArray]
) -> FloatArray:
    """Of pairs of outcomes, by :data:`CORRELATIONS` ``[R]`` [nats]."""
    p, q = ndtr(quantile[0]), ndtr(quantile[1])
    total = np.zeros(CORRELATIONS.size)
    for start in range(0, p.size, AT_A_TIME):
        rows = slice(start, start + AT_A_TIME)
        both = both_below(quantile[0][rows], quantile[1][rows], CORRELATIONS)
        one, other = missed[0][rows], missed[1][rows]
        chance = np.where(
            one & other,
            both,
            np.where(
                one,
                p[rows] - both,
                np.where(other, q[rows] - both, 1.0 - p[rows] - q[rows] + both),
            ),
        )
        total += np.log(chance.clip(1e-12)).sum(axis=1)
    return total


def fit_drifting(tracks: TrackTable, logit: FloatArray) -> Drifting:
    """Fit f, g and tau.

    Args:
        tracks: n observations, the frames of a track in order.
        logit: Out-of-fold logits of P(detected | state) ``[n]``.
    """
    quantile = miss_quantile(np.clip(logit, -12.0, 12.0))
    missed, frame = ~tracks.obstacles.detected, tracks.frame
    whose = np.stack([tracks.sequence, tracks.track])
    lags, found, weight = [], [], []
    for lag in LAGS:
        same = (whose[:, lag:] == whose[:, :-lag]).all(axis=0)
        rows = np.flatnonzero(same & (frame[lag:] - frame[:-lag] == lag))
        if rows.size < FEWEST_PAIRS:
            continue
        told = pair_log_likelihood(
            (quantile[rows], quantile[rows + lag]), (missed[rows], missed[rows + lag])
        )
        best = int(told.argmax())
        inner = min(max(best, 1), CORRELATIONS.size - 2)
        bend = told[inner - 1] - 2.0 * told[inner] + told[inner + 1]
        lags.append(lag * DT_S)
        found.append(CORRELATIONS[best])
        weight.append(np.sqrt(max(-bend, 1e-3)))
    return _through(np.array(lags), np.array(found), np.array(weight))


def _through(lag_s: FloatArray, found: FloatArray, weight: FloatArray) -> Drifting:
    """Weighted least squares on the correlations."""

    def of(parameters: FloatArray) -> Drifting:
        f, g, tau = np.exp(parameters)
        return Drifting(float(f), float(g), float(tau))

    def misses(parameters: FloatArray) -> FloatArray:
        return weight * (of(parameters).correlation(lag_s) - found)

    starts = [np.log([1.0, g, tau]) for g in (0.3, 1.0, 3.0) for tau in (0.15, 0.6, 2.0)]
    bounds = (np.log([0.01, 0.01, 0.03]), np.log([8.0, 8.0, 8.0]))
    tried = [least_squares(misses, start, bounds=bounds) for start in starts]
    least = int(np.argmin([float(one.cost) for one in tried]))
    return of(tried[least].x)


def failures(
    world: World, pem: Pem, visibility: Drifting, *, rollouts: int, seeds: np.random.SeedSequence
) -> int:
    """How many of plain rollouts with such a visibility fail; each car has one of its own."""
    failed = 0
    for own, start in zip(
        seeds.spawn(-(-rollouts // AT_A_TIME)), range(0, rollouts, AT_A_TIME), strict=True
    ):
        count = min(AT_A_TIME, rollouts - start)
        failed += int(_drive(world, pem, visibility, count, np.random.default_rng(own)).sum())
    return failed


def _drive(
    world: World, pem: Pem, visibility: Drifting, count: int, random: np.random.Generator
) -> BoolArray:
    shape = (count, world.cars)
    f, g = visibility.frailty, visibility.drift
    rho, scale = np.exp(-DT_S / visibility.tau_s), 1.0 / np.sqrt(1.0 + f**2 + g**2)
    states = world.begin(random.standard_normal((count, world.starts)))
    failed = world.failed(states.signals)
    lasting, slow = random.standard_normal(shape), random.standard_normal(shape)
    for _ in range(world.simulator.states - 1):
        salient = np.reshape(world.simulator.salient(states.signals), (count * world.cars, -1))
        quantile = miss_quantile(pem.logit(salient)).reshape(shape)
        latent = (f * lasting + g * slow + random.standard_normal(shape)) * scale
        states = world.step(states, latent >= quantile)
        failed |= world.failed(states.signals)
        slow = rho * slow + np.sqrt(1.0 - rho**2) * random.standard_normal(shape)
    return failed
