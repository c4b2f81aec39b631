"""Time-varying frailty: an obstacle's visibility lasts in part, and in part comes and goes.

Copied outcomes (:mod:`pemviz.pem.models.memory`) are late where P(missed) changes within the memory
time: copies of misses outlive it. A detector that looks at each image anew has no such inertia; its
misses hang together since what makes the obstacle hard to see does. One latent normal each frame,
with u standard normal for as long as the obstacle is there, w a stationary Ornstein-Uhlenbeck
process of unit variance with time tau, and e white (a frailty that varies with time; as a probit of
correlated normals: Chib & Greenberg 1998, Biometrika 85:347)::

    missed at t   if   e_t < Phi^-1(p_t) sqrt(1 + f^2 + g^2) + f u + g w_t

P(missed) is p_t in every frame, however fast the state changes. Frames h seconds apart have the
latent correlation (f^2 + g^2 exp(-h / tau)) / (1 + f^2 + g^2).

Neither u nor w is sampled: a filter carries their joint distribution on a grid, given the outcomes
so far. An outcome multiplies it by P(outcome | state, u, w); between frames w moves on. The
trapezoid rule converges as fast here as in :mod:`pemviz.pem.models.memory`. The grid's distances
are such that f u + g w takes few values, at which alone the normal distribution is evaluated.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import log_ndtr

from pemviz.arrays import BoolArray, FloatArray
from pemviz.chunks import distinct_rows
from pemviz.errors import PemError
from pemviz.pem.models.memory import miss_quantile

SMALLEST, SMALLEST_VARYING, LARGEST = 0.02, 0.01, 5.0
"""Of f where it is not 0, of g, and of both: the levels are the more, the less one is than the
other."""
SHORTEST_S, LONGEST_S = 0.01, 10.0
LEAST = 1e-150
"""Shares below this are taken for none: arithmetic with denormal numbers is slow, and it would take
outcomes whose probabilities differ by that much to bring such a pair of nodes back."""
CHUNK_ROWS = 64
ROWS = 16
"""Rollouts whose w is moved on at once: a matrix product may round otherwise in another shape."""


@dataclass(frozen=True)
class VaryingFrailty:
    """How much obstacles' visibility lasts and how much of it comes and goes.

    Attributes:
        frailty: f, spread of what lasts as long as the obstacle is there; 0: nothing does.
        varying: g, spread of what comes and goes.
        varying_s: Its correlation time tau [s].

    Raises:
        PemError: A value is out of range.
    """

    frailty: float
    varying: float
    varying_s: float

    def __post_init__(self) -> None:
        if self.frailty != 0.0 and not SMALLEST <= self.frailty <= LARGEST:
            allowed = f"0, or {SMALLEST:g} to {LARGEST:g}"
            raise PemError(f"frailty is {self.frailty:g}, allowed: {allowed}")
        if not SMALLEST_VARYING <= self.varying <= LARGEST:
            allowed = f"{SMALLEST_VARYING:g} to {LARGEST:g}"
            raise PemError(f"varying_frailty is {self.varying:g}, allowed: {allowed}")
        if not SHORTEST_S <= self.varying_s <= LONGEST_S:
            allowed = f"{SHORTEST_S:g} to {LONGEST_S:g} s"
            raise PemError(f"varying_frailty_s is {self.varying_s:g}, allowed: {allowed}")

    @property
    def label(self) -> str:
        """What lasts and what comes and goes, in words."""
        varying = f"time-varying frailty {self.varying:.3g} ({self.varying_s:.3g} s)"
        return f"frailty {self.frailty:.3g} and {varying}" if self.frailty else varying

    @property
    def scale(self) -> float:
        """Standard deviation of the latent, where e has 1."""
        return math.sqrt(1.0 + self.frailty**2 + self.varying**2)

    def latent_correlation(self, lag_s: FloatArray) -> FloatArray:
        """Of the latents of two frames so far apart, above 0 [s]."""
        slow = self.varying**2 * np.exp(-lag_s / self.varying_s)
        return (self.frailty**2 + slow) / self.scale**2


@dataclass(frozen=True)
class NodeGrid:
    """How fine the grid is.

    Attributes:
        farthest: Nodes lie within so many standard deviations; beyond 9, a normal has 2e-19 of its
            probability.
        of_lasting: Largest distance of the nodes of u for frailties up to 1; above, this over the
            frailty. Outcomes make what lasts ever better known, so that its nodes are closer.
        of_varying: Likewise of w.
    """

    farthest: float = 9.0
    of_lasting: float = 0.25
    of_varying: float = 0.7


@dataclass(frozen=True)
class VaryingNodes:
    """Nodes of u and w, for frames at least ``step_s`` apart [s]."""

    law: VaryingFrailty
    step_s: float
    grid: NodeGrid = NodeGrid()

    @cached_property
    def _distances(self) -> tuple[float, int, float, int]:
        """Of u and of w, each with how many steps of the levels it is."""
        f, g = self.law.frailty, self.law.varying
        # w moves by a normal of this spread, which the nodes have to resolve
        moves = math.sqrt(-math.expm1(-2.0 * self.step_s / self.law.varying_s))
        of_w = min(self.grid.of_varying / max(1.0, g), moves)
        if f == 0.0:
            return 1.0, 1, of_w, 1
        most = self.grid.of_lasting / max(1.0, f)
        if f * most >= g * of_w:
            times = math.floor(f * most / (g * of_w))
            return times * g * of_w / f, times, of_w, 1
        times = math.ceil(g * of_w / (f * most))
        return g * of_w / (f * times), 1, of_w, times

    @cached_property
    def u(self) -> FloatArray:
        """Nodes of what lasts ``[U]``; 0 alone without."""
        distance, *_ = self._distances
        return self._nodes(distance) if self.law.frailty else np.zeros(1)

    @cached_property
    def w(self) -> FloatArray:
        """Nodes of what comes and goes ``[W]``."""
        return self._nodes(self._distances[2])

    def _nodes(self, distance: float) -> FloatArray:
        half = math.ceil(self.grid.farthest / distance)
        return np.arange(-half, half + 1, dtype=np.float64) * distance

    @cached_property
    def levels(self) -> FloatArray:
        """Values of f u + g w ``[L]``: of the i-th u and the k-th w that at i a + k b."""
        _, of_u, distance, of_w = self._distances
        half = (of_u * (self.u.size - 1) + of_w * (self.w.size - 1)) // 2
        return np.arange(-half, half + 1, dtype=np.float64) * (self.law.varying * distance / of_w)

    def by_node(self, values: FloatArray) -> FloatArray:
        """Values of levels ``[N, L]`` as a view of those of the nodes ``[N, U, W]``."""
        _, of_u, _, of_w = self._distances
        width = of_w * (self.w.size - 1) + 1
        return sliding_window_view(values, width, axis=1)[:, ::of_u, ::of_w]

    def by_level(self, shares: FloatArray) -> FloatArray:
        """Sums over the nodes ``[N, U, W]`` of each level, ``[N, L]``."""
        _, of_u, _, of_w = self._distances
        sums, width = np.zeros((len(shares), self.levels.size)), of_w * (self.w.size - 1) + 1
        for place in range(self.u.size):
            sums[:, of_u * place : of_u * place + width : of_w] += shares[:, place]
        return sums

    @cached_property
    def prior(self) -> FloatArray:
        """Shares ``[U, W]`` before any outcome."""
        return np.outer(_weights(self.u), _weights(self.w))

    def begun(self, count: int) -> FloatArray:
        """The same of so many rollouts ``[N, U, W]``."""
        return np.tile(self.prior, (count, 1, 1))

    def moved_on(self, since_s: float) -> FloatArray:
        """Probabilities of w so much later, ``[W, W]`` from rows to columns."""
        rho = math.exp(-since_s / self.law.varying_s)
        apart = self.w - rho * self.w[:, None]
        log_weight = -0.5 * apart**2 / (1.0 - rho**2)
        weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        return np.where(weight < LEAST, 0.0, weight)

    def log_outcomes(self, own: FloatArray, missed: BoolArray) -> FloatArray:
        """Log probability of outcomes ``[N]`` by level, ``[N, L]``.

        From the logits of P(detected) of the model of single outcomes ``[N]``. Rollouts meet few
        states, since equal outcomes lead to equal ones: those are evaluated once.
        """
        sign = np.where(missed, 1.0, -1.0)
        same = distinct_rows(np.stack([own, sign], axis=1)) if own.size >= ROWS else None
        if same is None:
            return self._log_outcomes(own, sign)
        first, place = same
        return self._log_outcomes(own[first], sign[first])[place]

    def _log_outcomes(self, own: FloatArray, sign: FloatArray) -> FloatArray:
        middle = miss_quantile(own) * self.law.scale
        return log_ndtr(sign[:, None] * (middle[:, None] + self.levels))

    def logit_and_mean(
        self, shares: FloatArray, log_hit: FloatArray, log_miss: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Logit of P(detected | outcomes so far), and the mean visibility, ``[N]`` each.

        The latter is that of (f u + g w) / sqrt(f^2 + g^2); the larger, the harder to see. From the
        shares of the nodes ``[N, U, W]`` before the outcome, and what :meth:`log_outcomes` gives
        either.
        """
        at = self.by_level(shares)
        spread = math.hypot(self.law.frailty, self.law.varying)
        mean = (at * (self.levels / spread)).sum(axis=1)
        return _log_sums(log_hit, at) - _log_sums(log_miss, at), mean

    def after(self, shares: FloatArray, log_p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Shares of the nodes ``[N, U, W]`` after outcomes, at the same moment.

        From what :meth:`log_outcomes` gives these, ``[N, L]``.

        Returns:
            These, and the log probabilities of the outcomes ``[N]``.
        """
        largest = log_p.max(axis=1)
        shares = shares * self.by_node(np.exp(log_p - largest[:, None]))
        total = shares.sum(axis=(1, 2))
        shares /= total[:, None, None]
        shares[shares < LEAST] = 0.0
        return shares, np.log(total) + largest

    def later(self, shares: FloatArray, moves: FloatArray) -> FloatArray:
        """Shares ``[N, U, W]`` after w has moved on by ``moves [W, W]``."""
        result = np.empty_like(shares)
        for start in range(0, len(shares), ROWS):
            part = shares[start : start + ROWS]
            count = len(part)
            if count < ROWS:
                part = np.concatenate([part, np.zeros((ROWS - count, *part.shape[1:]))])
            found = part.reshape(-1, self.w.size) @ moves
            result[start : start + count] = found.reshape(part.shape)[:count]
        return result

    def log_likelihood(self, own: FloatArray, detected: BoolArray) -> FloatArray:
        """Log likelihood of chains of outcomes ``[N, T]``, ``step_s`` apart, from their logits."""
        moves = self.moved_on(self.step_s)
        log_p = np.empty(len(detected))
        for rows in chunks(len(detected)):
            log_p[rows] = self._log_likelihood(own[rows], detected[rows], moves)
        return log_p

    def _log_likelihood(
        self, own: FloatArray, detected: BoolArray, moves: FloatArray
    ) -> FloatArray:
        shares, log_p = self.begun(len(detected)), np.zeros(len(detected))
        for step in range(detected.shape[1]):
            shares = self.later(shares, moves) if step else shares
            log_outcomes = self.log_outcomes(own[:, step], ~detected[:, step])
            shares, told = self.after(shares, log_outcomes)
            log_p += told
        return log_p


def chunks(count: int) -> Iterator[slice]:
    """So many rollouts, some at a time: what they need stays in a core's cache."""
    return (slice(start, start + CHUNK_ROWS) for start in range(0, count, CHUNK_ROWS))


def _weights(nodes: FloatArray) -> FloatArray:
    weight = np.exp(-0.5 * nodes**2)
    return weight / weight.sum()


def _log_sums(log_values: FloatArray, shares: FloatArray) -> FloatArray:
    """Log of the means of exp of ``log_values [N, L]``, each counting by its share."""
    largest = log_values.max(axis=1)
    return np.log((np.exp(log_values - largest[:, None]) * shares).sum(axis=1)) + largest
