"""Time-varying frailty: an obstacle's visibility lasts in part, and in part comes and goes.

Copied outcomes (:mod:`pemviz.pem.models.memory`) are late where P(missed) changes within the memory
time: copies of misses outlive it. A detector that looks at each image anew has no such inertia; its
misses hang together since what makes the obstacle hard to see does. One latent normal each frame,
with u standard normal for as long as the obstacle is there, w a stationary Ornstein-Uhlenbeck
process of unit variance with time tau, and e white (a frailty that varies: Yau & McGilchrist 1998,
Statistics in Medicine 17:1201; as a probit: Chib & Greenberg 1998, Biometrika 85:347)::

    missed at t   if   e_t < Phi^-1(p_t) sqrt(1 + f^2 + g^2) + f u + g w_t

P(missed) is p_t in every frame, however fast the state changes. Frames h seconds apart have the
latent correlation (f^2 + g^2 exp(-h / tau)) / (1 + f^2 + g^2).

Neither u nor w is sampled: a filter carries their joint distribution on a grid, given the outcomes
so far. An outcome multiplies it by P(outcome | state, u, w); between frames w moves on. The
trapezoid rule converges as fast here as in :mod:`pemviz.pem.models.memory`. The grid's distances
are such that f u + g w takes few values, at which alone the normal distribution is evaluated.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import log_ndtr

from pemviz.arrays import BoolArray, FloatArray
from pemviz.chunks import FEWEST, distinct_rows
from pemviz.errors import PemError
from pemviz.pem.models.memory import miss_quantile

LARGEST = 5.0
SHORTEST_S, LONGEST_S = 0.01, 10.0
FARTHEST_NODE = 9.0
"""Nodes lie within +-9 standard deviations: beyond, a normal has 2e-19 of its probability."""
LASTING_SPACING, VARYING_SPACING = 0.25, 0.6
"""Distances of the nodes for frailties up to 1; above, these over the frailty. Outcomes make what
lasts ever better known, so that its nodes are closer."""
LEAST = 1e-150
"""Shares below this are taken for none: arithmetic with denormal numbers is slow, and it would take
outcomes whose probabilities differ by that much to bring such a pair of nodes back."""
ROWS = 16
"""Rollouts whose w is moved on at once: a matrix product may round otherwise in another shape."""


@dataclass(frozen=True)
class VaryingFrailty:
    """How much obstacles' visibility lasts and how much of it comes and goes.

    Attributes:
        frailty: f, spread of what lasts as long as the obstacle is there; 0: nothing does.
        varying: g, spread of what comes and goes, above 0.
        varying_s: Its correlation time tau [s].

    Raises:
        PemError: A value is out of range.
    """

    frailty: float
    varying: float
    varying_s: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.frailty <= LARGEST:
            raise PemError(f"frailty is {self.frailty:g}, allowed: 0 to {LARGEST:g}")
        if not 0.0 < self.varying <= LARGEST:
            raise PemError(f"varying_frailty is {self.varying:g}, allowed: above 0, to {LARGEST:g}")
        if not SHORTEST_S <= self.varying_s <= LONGEST_S:
            allowed = f"{SHORTEST_S:g} to {LONGEST_S:g} s"
            raise PemError(f"varying_frailty_s is {self.varying_s:g}, allowed: {allowed}")

    @property
    def scale(self) -> float:
        """Standard deviation of the latent, where e has 1."""
        return math.sqrt(1.0 + self.frailty**2 + self.varying**2)

    def latent_correlation(self, lag_s: FloatArray) -> FloatArray:
        """Of the latents of two frames so far apart, above 0 [s]."""
        slow = self.varying**2 * np.exp(-lag_s / self.varying_s)
        return (self.frailty**2 + slow) / self.scale**2


@dataclass(frozen=True)
class VaryingNodes:
    """Grid of u and w, for frames at least ``step_s`` apart [s]."""

    law: VaryingFrailty
    step_s: float

    @cached_property
    def _distances(self) -> tuple[float, int, float, int]:
        """Of u and of w, each with how many steps of the levels it is."""
        f, g = self.law.frailty, self.law.varying
        # w moves by a normal of this spread, which the nodes have to resolve
        moves = math.sqrt(-math.expm1(-2.0 * self.step_s / self.law.varying_s))
        of_w = min(VARYING_SPACING / max(1.0, g), moves)
        if f == 0.0:
            return 1.0, 1, of_w, 1
        most = LASTING_SPACING / max(1.0, f)
        if f * most >= g * of_w:
            times = math.floor(f * most / (g * of_w))
            return times * g * of_w / f, times, of_w, 1
        times = math.ceil(g * of_w / (f * most))
        return g * of_w / (f * times), 1, of_w, times

    @cached_property
    def u(self) -> FloatArray:
        """Nodes of what lasts ``[U]``; 0 alone without."""
        distance, *_ = self._distances
        return _nodes(distance) if self.law.frailty else np.zeros(1)

    @cached_property
    def w(self) -> FloatArray:
        """Nodes of what comes and goes ``[W]``."""
        return _nodes(self._distances[2])

    @cached_property
    def levels(self) -> FloatArray:
        """Values of f u + g w ``[L]``: of the i-th u and the k-th w that at i a + k b."""
        _, of_u, distance, of_w = self._distances
        half = (of_u * (self.u.size - 1) + of_w * (self.w.size - 1)) // 2
        return np.arange(-half, half + 1) * (self.law.varying * distance / of_w)

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

        From the logits of P(detected) of the model of single outcomes ``[N]``.
        """
        sign = np.where(missed, 1.0, -1.0)
        return map_pairs(self._log_outcomes, own, sign)

    def _log_outcomes(self, own: FloatArray, sign: FloatArray) -> FloatArray:
        middle = miss_quantile(own) * self.law.scale
        return log_ndtr(sign[:, None] * (middle[:, None] + self.levels))

    def logit_and_mean(self, shares: FloatArray, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Logit of P(detected | outcomes so far), and the mean visibility, ``[N]`` each.

        The latter is that of (f u + g w) / sqrt(f^2 + g^2); the larger, the harder to see. From the
        shares of the nodes ``[N, U, W]`` before the outcome, and the logits ``[N]`` as above.
        """
        at, every = self.by_level(shares), np.ones(own.shape, dtype=np.bool_)
        logit = _log_sums(self.log_outcomes(own, ~every), at)
        logit -= _log_sums(self.log_outcomes(own, every), at)
        spread = math.hypot(self.law.frailty, self.law.varying)
        return logit, (at * (self.levels / spread)).sum(axis=1)

    def after(
        self, shares: FloatArray, own: FloatArray, missed: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Shares of the nodes ``[N, U, W]`` after outcomes ``[N]``, at the same moment.

        Returns:
            These, and the log probabilities of the outcomes ``[N]``.
        """
        log_p = self.log_outcomes(own, missed)
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
        for start in range(0, len(detected), 16 * ROWS):  # what they need stays in the cache
            rows = slice(start, start + 16 * ROWS)
            log_p[rows] = self._log_likelihood(own[rows], detected[rows], moves)
        return log_p

    def _log_likelihood(
        self, own: FloatArray, detected: BoolArray, moves: FloatArray
    ) -> FloatArray:
        shares, log_p = self.begun(len(detected)), np.zeros(len(detected))
        for step in range(detected.shape[1]):
            shares = self.later(shares, moves) if step else shares
            shares, told = self.after(shares, own[:, step], ~detected[:, step])
            log_p += told
        return log_p


def sampled_misses(
    law: VaryingFrailty, logit: FloatArray, *, since_s: FloatArray, random: np.random.Generator
) -> BoolArray:
    """Whether a chain of frames is missed, S times over ``[S, T]``.

    Args:
        law: Of the visibility.
        logit: Logits of P(detected) ``[S, T]``.
        since_s: Time since the frame before ``[T]`` [s]; of the first nothing is asked.
        random: Where from.
    """
    count, frames = logit.shape
    lasting, slow = random.standard_normal((2, count))
    middle, missed = miss_quantile(logit) * law.scale, np.empty(logit.shape, dtype=np.bool_)
    for frame in range(frames):
        if frame:
            rho = math.exp(-float(since_s[frame]) / law.varying_s)
            slow = rho * slow + math.sqrt(1.0 - rho**2) * random.standard_normal(count)
        seen = middle[:, frame] + law.frailty * lasting + law.varying * slow
        missed[:, frame] = random.standard_normal(count) < seen
    return missed


def _nodes(distance: float) -> FloatArray:
    half = math.ceil(FARTHEST_NODE / distance)
    return np.arange(-half, half + 1) * distance


def _weights(nodes: FloatArray) -> FloatArray:
    weight = np.exp(-0.5 * nodes**2)
    return weight / weight.sum()


def _log_sums(log_values: FloatArray, shares: FloatArray) -> FloatArray:
    """Log of the means of exp of ``log_values [N, L]``, each counting by its share."""
    largest = log_values.max(axis=1)
    return np.log((np.exp(log_values - largest[:, None]) * shares).sum(axis=1)) + largest


def map_pairs(
    function: Callable[[FloatArray, FloatArray], FloatArray], first: FloatArray, other: FloatArray
) -> FloatArray:
    """Rows ``[N, L]`` of pairs of numbers ``[N]``, each distinct pair evaluated once."""
    same = distinct_rows(np.stack([first, other], axis=1)) if first.size >= FEWEST else None
    if same is None:
        return function(first, other)
    one, place = same
    return function(first[one], other[one])[place]
