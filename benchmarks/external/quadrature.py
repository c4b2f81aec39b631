"""How likely a function of standard normals is below 0, by quadrature and by numpy alone."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize
from scipy.special import expit, logsumexp, ndtr

from benchmarks.external.motions import Flags, LimitFunction, Motion, Numbers

REACH = 10.0
"""Beyond so many standard deviations there is 1e-22 or less."""
CHUNK = 100_000


@dataclass(frozen=True)
class Known:
    """A probability.

    Attributes:
        value: It.
        relative_error: Standard error as a share of it; 0 where quadrature or a formula gives it.
        how: In words.
    """

    value: float
    relative_error: float = 0.0
    how: str = ""

    @classmethod
    def counted(cls, failing: int, count: int, how: str) -> "Known":
        """By plain rollouts of which so many fail; ``how`` is said beside their number."""
        value = failing / count
        error = np.sqrt((1.0 - value) / max(failing, 1)) if failing else np.inf
        return cls(value, float(error), f"{count:,} plain rollouts, {how}")


def by_radius(function: LimitFunction, *, angles: int = 8000, points: int = 1500) -> Known:
    """Of two standard normals: over angles, and exactly over the radius beyond each root."""
    grid = np.linspace(0.0, REACH, points)

    def at(angle: Numbers, radius: Numbers) -> Numbers:
        return function(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1))

    lines = np.linspace(0.0, 2.0 * np.pi, angles, endpoint=False) + np.pi / angles
    mass = _mass(at, lines, grid, beyond=lambda radius: np.exp(-0.5 * radius**2))
    return Known(float(mass.mean()), how="quadrature over angles, the radius exactly")


def by_column(function: LimitFunction, *, columns: int = 8000, points: int = 1500) -> Known:
    """Of two standard normals: over the first, and exactly over the second beyond each root."""
    grid = np.linspace(-REACH, REACH, points)
    width = 2.0 * REACH / columns
    lines = np.linspace(-REACH, REACH, columns, endpoint=False) + 0.5 * width

    def at(first: Numbers, second: Numbers) -> Numbers:
        return function(np.stack([first, second], axis=-1))

    mass = _mass(at, lines, grid, beyond=lambda second: ndtr(-second))
    density = np.exp(-0.5 * lines**2) / np.sqrt(2.0 * np.pi)
    return Known(float(width * (density @ mass)), how="quadrature over x1, x2 exactly")


def _mass(
    at: Callable[[Numbers, Numbers], Numbers],
    lines: Numbers,
    grid: Numbers,
    *,
    beyond: Callable[[Numbers], Numbers],
) -> Numbers:
    """The mass on each line where the function is below 0; its ends are found by bisection."""
    mass = np.zeros(lines.size)
    for first in range(0, lines.size, 500):
        some = lines[first : first + 500]
        line, place = (part.ravel() for part in np.meshgrid(some, grid, indexing="ij"))
        below = (at(line, place) < 0.0).reshape(some.size, grid.size)
        row, column = np.nonzero(below[:, 1:] != below[:, :-1])
        low, high, enters = grid[column], grid[column + 1], below[row, column + 1]
        for _ in range(45):
            middle = 0.5 * (low + high)
            reached = (at(some[row], middle) < 0.0) == enters
            low, high = np.where(reached, low, middle), np.where(reached, middle, high)
        signed = np.where(enters, 1.0, -1.0) * beyond(high)
        mass[first : first + 500] = np.bincount(row, weights=signed, minlength=some.size)
        mass[first : first + 500] += np.where(below[:, 0], beyond(grid[:1]), 0.0)
    return mass


def design_point(function: LimitFunction, start: Numbers) -> Numbers:
    """The nearest point to the origin at which the function is 0, from ``start [D]``."""

    def squared(x: Numbers) -> float:
        return float(x @ x)

    def limit(x: Numbers) -> float:
        return float(function(x[None, :])[0])

    found: Any = optimize.minimize(
        squared,
        start,
        constraints=[{"type": "eq", "fun": limit}],
        method="SLSQP",
    )
    return np.asarray(found.x)


def importance(
    function: LimitFunction, centres: Numbers, *, sd: Numbers | float = 1.0, count: int, seed: int
) -> Known:
    """Importance sampling from normals around ``centres [K, D]``, with a tenth from the model.

    With importance weights that are below 10 whatever happens (Owen, Zhou 2000).
    """
    rng = np.random.default_rng(seed)
    spread = np.broadcast_to(np.asarray(sd, dtype=np.float64), centres[0].shape)
    sums = np.zeros(2)
    for size in _sizes(count, CHUNK * 10 // max(10, centres.size)):
        chosen = rng.integers(len(centres), size=size)
        x = rng.standard_normal((size, centres.shape[1]))
        away = rng.random(size) >= 0.1
        x[away] = centres[chosen[away]] + spread * x[away]
        weight = np.where(function(x) < 0.0, np.exp(-_log_ratio(x, centres, spread)), 0.0)
        sums += weight.sum(), (weight**2).sum()
    return _averaged(sums, count, f"{count:,} importance samples around known points, numpy alone")


def _log_ratio(x: Numbers, centres: Numbers, spread: Numbers) -> Numbers:
    """Log of the sampled density over the model's."""
    plain = -0.5 * (x**2).sum(axis=1)
    around = [
        -0.5 * (((x - centre) / spread) ** 2).sum(axis=1) - np.log(spread).sum()
        for centre in centres
    ]
    moved = logsumexp(around, axis=0) - np.log(len(centres)) - plain
    return np.logaddexp(np.log(0.1), np.log(0.9) + moved)


def plain(motion: Motion, *, count: int, seed: int) -> Known:
    """Plain Monte Carlo rollouts of a motion.

    Args:
        motion: What moves.
        count: Rollouts.
        seed: Of numpy's generator.
    """
    rng = np.random.default_rng(seed)
    failing = 0
    for size in _sizes(count, CHUNK):
        values = motion.begin(rng.standard_normal((size, motion.starts)))
        failed: Flags = motion.margin(values) < 0.0
        detected = np.ones(size, dtype=np.bool_)
        for step in range(motion.steps):
            if motion.misses:
                detected = rng.random(size) < expit(motion.logit(values))
            noise = rng.standard_normal((size, motion.noises))
            values = motion.move(values, step, detected, noise)
            failed |= motion.margin(values) < 0.0
        failing += int(failed.sum())
    return Known.counted(failing, count, "numpy alone")


WINDOW, UNTILTED = 12, 0.1
"""Steps of a window of misses; share of rollouts without one."""


def by_windows(motion: Motion, *, count: int, seed: int) -> Known:
    """Importance sampling of a motion that misses alone decide and that stays once it has failed.

    In one window of steps, uniform over where it begins, logits above 0 are sampled as 0; a tenth
    of the rollouts have none. Weights are against the mixture of all windows, so that each is
    below 10 whatever happens (Owen, Zhou 2000).
    """
    rng = np.random.default_rng(seed)
    begins = np.arange(1 - WINDOW, motion.steps)
    sums = np.zeros(2)
    for size in _sizes(count, CHUNK // 5):
        first = rng.choice(begins, size=size)
        first[rng.random(size) < UNTILTED] = motion.steps
        log_ratio = _window_log_ratios(motion, first, rng)
        inside = np.zeros(log_ratio.shape[1])
        for begin in begins:
            end = min(motion.steps, begin + WINDOW)
            inside += np.exp(log_ratio[end] - log_ratio[max(begin, 0)])
        weight = 1.0 / (UNTILTED + (1.0 - UNTILTED) * inside / begins.size)
        sums += weight.sum(), (weight**2).sum()
    return _averaged(sums, count, f"{count:,} rollouts with a window of misses, numpy alone")


def _window_log_ratios(motion: Motion, first: Any, rng: np.random.Generator) -> Numbers:
    """Of rollouts that fail, ``[steps + 1, N]``: what windows up to each step would add."""
    values = motion.begin(np.empty((first.size, 0)))
    failed: Flags = motion.margin(values) < 0.0
    summed = np.zeros((motion.steps + 1, first.size))
    for step in range(motion.steps):
        logit = motion.logit(values)
        low = np.minimum(logit, 0.0)
        tilted = (first <= step) & (step < first + WINDOW)
        detected = rng.random(first.size) < expit(np.where(tilted, low, logit))
        ratio = np.logaddexp(0.0, logit) - np.logaddexp(0.0, low)
        ratio += np.where(detected, low - logit, 0.0)
        summed[step + 1] = summed[step] + np.where(failed, 0.0, ratio)
        values = motion.move(values, step, detected, np.empty((first.size, 0)))
        failed |= motion.margin(values) < 0.0
    return summed[:, failed]


def _averaged(sums: Numbers, count: int, how: str) -> Known:
    mean, square = sums / count
    error = np.sqrt(max(square - mean**2, 0.0) / count)
    return Known(float(mean), float(error / mean) if mean > 0.0 else np.inf, how)


def _sizes(count: int, largest: int) -> list[int]:
    whole, rest = divmod(count, max(1, largest))
    return [largest] * whole + [rest] * (rest > 0)
