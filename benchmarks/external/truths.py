"""Every problem's probability, found twice: ``python -m benchmarks external --truths``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
from scipy import integrate, ndimage, optimize, stats
from scipy.special import expit, k0, ndtr, ndtri_exp

from benchmarks.external.catalogue import problems
from benchmarks.external.motions import Motion, Numbers, limit_function
from benchmarks.external.quadrature import (
    Known,
    by_column,
    by_radius,
    by_windows,
    design_point,
    importance,
    plain,
)
from benchmarks.external.sequential import (
    QUARTER_PI,
    LargestError,
    Pendulum,
    SensedPendulum,
    SumOfErrors,
    WalkBesidePattern,
    WetFloor,
    swung,
)
from benchmarks.external.static import STATIC, exponentials

Way = Callable[[], Known]
SEED = 20261124
"""Of what is sampled here."""


def _static(name: str) -> Callable[[Numbers], Numbers]:
    return limit_function(STATIC[name])


def _planar(name: str) -> tuple[Way, Way]:
    return lambda: by_radius(_static(name)), lambda: by_column(_static(name))


def _formula(value: float, how: str) -> Known:
    return Known(float(value), how=how)


def _near_design_points(name: str, starts: Numbers, *, count: int = 1_000_000) -> Known:
    """Importance sampling around the design points that are found from ``starts [K, D]``."""
    function = _static(name)
    centres = np.array([design_point(function, start) for start in starts])
    return importance(function, centres, count=count, seed=SEED)


def _rp8() -> Known:
    """The density of each scaled log-normal on a grid; those of sums by Fourier transforms."""
    step, size = 0.05, 2**17
    transform = np.ones(size // 2 + 1, dtype=np.complex128)
    parts = [(120, 12, 1), (120, 12, 2), (120, 12, 2), (120, 12, 1), (50, 10, -5), (40, 8, -5)]
    for mean, sd, factor in parts:
        spread = np.sqrt(np.log1p((sd / mean) ** 2))
        law = stats.lognorm(spread, scale=abs(factor) * mean * np.exp(-0.5 * spread**2))
        ends = step * (np.arange(size // 2 + 1) - 0.5)
        mass = np.zeros(size)
        mass[: size // 2] = np.diff(law.cdf(ends))
        if factor < 0:
            mass = np.roll(mass[::-1], 1)
        transform *= np.fft.rfft(mass)
    total = np.fft.irfft(transform, size)
    below = total[size // 2 :].sum() + 0.5 * total[0]
    return _formula(below, f"convolution of densities in steps of {step:g}")


def _rp14() -> Known:
    """The uniform strength exactly, the rest over Gauss-Hermite points."""
    few, weight_few = np.polynomial.hermite_e.hermegauss(7)
    z = np.linspace(-8.0, 8.0, 1601)
    density = stats.norm.pdf(z)
    scale = 350.0 * np.sqrt(6.0) / np.pi
    force = 1500.0 - np.euler_gamma * scale - scale * np.log(-stats.norm.logcdf(z))
    torque = 250_000.0 + 35_000.0 * z
    total = 0.0
    for width, length in product(range(few.size), repeat=2):
        lever = (force * (400.0 + 0.1 * few[length])) ** 2 / 16.0
        stress = np.sqrt(lever[:, None] + torque[None, :] ** 2)
        stress *= 32.0 / (np.pi * (39.0 + 0.1 * few[width]) ** 3)
        failing = density @ np.clip((stress - 70.0) / 10.0, 0.0, 1.0) @ density * 0.01**2
        total += weight_few[width] * weight_few[length] * failing
    return _formula(total / (2.0 * np.pi), "quadrature over four, the strength exactly")


def _rp55() -> Known:
    """The difference is triangular: beyond d with a probability of (1 - d / 2)^2."""

    def along(apart: float) -> float:
        return 0.2 + 0.6 * apart**4 - apart / np.sqrt(2.0)

    solve: Any = optimize.brentq
    first, last = (float(solve(along, *ends, xtol=1e-14)) for ends in ((0.0, 0.6), (0.6, 2.0)))
    beyond = [(1.0 - apart / 2.0) ** 2 for apart in (first, last, 5.0 / np.sqrt(2.0) - 2.2)]
    return _formula(beyond[0] - beyond[1] + beyond[2], "formula")


def _rp60() -> Known:
    """Given the load the strengths are independent: one integral."""
    spreads = np.sqrt(np.log1p(np.array([0.1, 0.1, 0.1, 0.1, 0.4]) ** 2))
    means = np.array([2200.0, 2100.0, 2300.0, 2000.0, 1200.0])
    medians = means * np.exp(-0.5 * spreads**2)
    z = np.linspace(-9.0, 9.0, 20_001)
    load = medians[4] * np.exp(spreads[4] * z)
    whole = [ndtr(np.log(load / m) / s) for m, s in zip(medians[:4], spreads[:4], strict=True)]
    half = [ndtr(np.log(load / 2 / m) / s) for m, s in zip(medians[:4], spreads[:4], strict=True)]
    survive_whole = (1.0 - whole[1]) * (1.0 - whole[2])
    survive_half = (1.0 - half[1]) * (1.0 - half[2])
    below = whole[3] * (1.0 - survive_whole)
    spared = (whole[3] - half[3]) * (survive_half - survive_whole)
    fails = whole[0] + (1.0 - whole[0]) * (below - spared)
    value = np.trapezoid(fails * stats.norm.pdf(z), z)
    return _formula(value, "quadrature over the load, the strengths exactly")


def _rp63() -> Known:
    def below(total: float) -> float:
        return float(stats.chi2.pdf(total, 99) * ndtr(4.5 - 0.1 * total))

    value, _ = integrate.quad(below, 0.0, 400.0, points=[60, 80, 100], limit=400, epsrel=1e-11)
    return _formula(value, "integral over chi-square")


def _rp63_sampled() -> Known:
    centre, spread = np.zeros(100), np.full(100, 0.87)
    centre[0], spread[0] = 3.0, 1.0
    return importance(_static("RP63"), centre[None, :], sd=spread, count=500_000, seed=SEED)


def _rp77() -> Known:
    """On both sides of x3 = 5: two normals with a common part."""
    z = np.concatenate([np.linspace(-10.0, 1.0, 100_001), np.linspace(1.0, 10.0, 100_001)])
    fails = np.where(
        np.arange(z.size) <= 100_000, ndtr((z - 6.0) / np.hypot(0.5, 1.0)), ndtr(-4.0 - z)
    )
    value = np.trapezoid(fails * stats.norm.pdf(z), z)
    return _formula(value, "quadrature over x3, the others exactly")


def _rp77_sampled() -> Known:
    centres = np.array([[-0.8, 3.6, 1.0], [0.0, 5.0, 1.0]])
    return importance(_static("RP77"), centres, count=1_000_000, seed=SEED)


def _two_halves(one: float, other: float, correlation: float) -> float:
    """P(Z1 > one or Z2 > other)."""
    rest = np.sqrt(1.0 - correlation**2)

    def both(z: float) -> float:
        return float(stats.norm.pdf(z) * ndtr((correlation * z - other) / rest))

    together, _ = integrate.quad(both, one, np.inf, epsabs=0.0, epsrel=1e-11)
    return float(ndtr(-one) + ndtr(-other)) - float(together)


def _linear_sampled(name: str, beta: float) -> Known:
    count = STATIC[name].starts
    centre = np.full((1, count), beta / np.sqrt(count))
    return importance(_static(name), centre, count=1_000_000, seed=SEED)


def _planes_sampled() -> Known:
    ones, signs = np.full(100, 0.1), np.where(np.arange(100) % 2 == 0, 0.1, -0.1)
    centres = np.array([4.5 * ones, -5.0 * signs])
    return importance(_static("two planes, 100"), centres, count=500_000, seed=SEED)


def _exponentials_sampled(name: str, mean: float, *, count: int) -> Known:
    """Exponentials of another mean, weighed; given to the problem as normals."""
    rng, motion = np.random.default_rng(SEED), STATIC[name]
    sums, batch = np.zeros(2), 20_000
    for _ in range(count // batch):
        sampled = mean * rng.standard_exponential((batch, motion.starts))
        log_ratio = (sampled / mean - sampled).sum(axis=1) + motion.starts * np.log(mean)
        x = -ndtri_exp(-sampled)
        assert np.allclose(exponentials(x), sampled)  # noqa: S101
        weight = np.where(motion.function(x) < 0.0, np.exp(log_ratio), 0.0)
        sums += weight.sum(), (weight**2).sum()
    average, square = sums / count
    error = float(np.sqrt((square - average**2) / count) / average)
    return Known(float(average), error, f"{count:,} samples of mean {mean:g} with their weights")


def _swinging(motion: Pendulum, nodes: int = 121, cells: int = 120) -> Known:
    """The probability of falling from each angle and rate, backwards over the steps.

    Between the states by cubic splines: 200 cells instead of 120 change it by 0.05 %.
    """
    angles = np.linspace(-QUARTER_PI, QUARTER_PI, cells + 1)
    rates = np.linspace(-8.0, 8.0, 4 * cells + 1)
    angle, rate = np.meshgrid(angles, rates, indexing="ij")
    state = {"angle": angle, "rate": rate}
    falls = np.zeros(angle.shape)
    for _ in range(motion.steps):
        before, falls = falls, np.zeros(angle.shape)
        for torque, weight in _torques(motion, state, nodes):
            dt_s = 0.05 if isinstance(motion, SensedPendulum) else 0.1
            later = swung(state, torque, dt_s=dt_s)
            place = [
                (later["angle"] + QUARTER_PI) / (angles[1] - angles[0]),
                (later["rate"] + 8.0) / (rates[1] - rates[0]),
            ]
            inside = np.abs(later["angle"]) <= QUARTER_PI
            found = ndimage.map_coordinates(before, place, order=3, mode="nearest")
            falls += weight * np.where(inside, found, 1.0)
    z = np.linspace(-7.5, 7.5, 901)
    first, second = np.meshgrid(z, z, indexing="ij")
    begun = motion.begin(np.stack([first.ravel(), second.ravel()], axis=-1))
    place = [
        (begun["angle"] + QUARTER_PI) / (angles[1] - angles[0]),
        (begun["rate"] + 8.0) / (rates[1] - rates[0]),
    ]
    found = ndimage.map_coordinates(falls, place, order=3, mode="nearest")
    found = np.where(np.abs(begun["angle"]) <= QUARTER_PI, found, 1.0)
    density = stats.norm.pdf(z) * (z[1] - z[0])
    value = float(density @ found.reshape(first.shape) @ density)
    return Known(value, 1e-3, f"backwards over {cells + 1} x {rates.size} states")


def _torques(
    motion: Pendulum, state: Mapping[str, Numbers], nodes: int
) -> list[tuple[Numbers, Numbers | float]]:
    if not isinstance(motion, SensedPendulum):
        wanted, z = motion.control(state), np.linspace(-7.0, 7.0, nodes)
        weight = stats.norm.pdf(z)
        return [
            (wanted + motion.sd * one, float(share))
            for one, share in zip(z, weight / weight.sum(), strict=True)
        ]
    wanted, sd = -15.0 * state["angle"] - 8.0 * state["rate"], 1.7  # of 15 e1 + 8 e2, each of 0.1
    edges = np.linspace(-2.0, 2.0, nodes)
    parts: list[tuple[Numbers, Numbers | float]] = [
        (np.full(wanted.shape, -2.0), ndtr((-2.0 - wanted) / sd)),
        (np.full(wanted.shape, 2.0), ndtr((wanted - 2.0) / sd)),
    ]
    for low, high in pairwise(edges):
        share = ndtr((high - wanted) / sd) - ndtr((low - wanted) / sd)
        parts.append((np.full(wanted.shape, 0.5 * (low + high)), share))
    return parts


def _largest(motion: LargestError) -> Known:
    each = 2.0 * ndtr(-motion.limit)
    return _formula(-np.expm1(motion.steps * np.log1p(-each)), "formula")


def _largest_sampled(motion: LargestError) -> Known:
    centres = motion.limit * np.concatenate([np.eye(motion.steps), -np.eye(motion.steps)])
    return importance(limit_function(motion), centres, count=200_000, seed=SEED)


def _sum_sampled(motion: SumOfErrors) -> Known:
    centre = np.full(motion.steps, motion.limit / np.sqrt(motion.steps))
    centres = np.array([centre, -centre])
    return importance(limit_function(motion), centres, count=1_000_000, seed=SEED)


def _pattern(motion: WalkBesidePattern) -> Known:
    """Over gaps and whether all of the pattern was missed, step by step."""
    mass = {(motion.first, True): 1.0}
    failed = 0.0
    for step in range(motion.steps):
        later: dict[tuple[int, bool], float] = {}
        for (gap, unseen), share in mass.items():
            detects = float(expit(motion.at_zero + motion.slope * gap))
            for seen, likely in ((True, detects), (False, 1.0 - detects)):
                to = min(gap + (1 if seen else -1), motion.first + 2)
                still = unseen and not (seen and step in motion.pattern)
                if to <= 0 or (step == motion.steps - 1 and still):
                    failed += share * likely
                else:
                    later[to, still] = later.get((to, still), 0.0) + share * likely
        mass = later
    return _formula(failed, "recursion over gaps")


def _floors(motion: WetFloor, *, count: int = 100_000) -> Known:
    """Over when it first sees, exactly; starts are drawn, as many of either floor."""
    start = np.random.default_rng(SEED).standard_normal((count, motion.starts))

    def share(wet_above: float) -> Numbers:
        floor = replace(motion, wet_above=wet_above)
        waiting, found, unseen = floor.begin(start), np.zeros(count), np.ones(count)
        none, all_see = np.zeros(count, dtype=np.bool_), np.ones(count, dtype=np.bool_)
        for step in range(motion.steps):
            sees = expit(floor.logit(waiting))
            braking, least = waiting, floor.margin(waiting)
            for later in range(step, motion.steps):
                braking = floor.move(braking, later, all_see, start)
                least = np.minimum(least, floor.margin(braking))
            found += np.where(least < 0.0, unseen * sees, 0.0)
            unseen = unseen * (1.0 - sees)
            waiting = floor.move(waiting, step, none, start)
        return found + np.where(floor.margin(waiting) < 0.0, unseen, 0.0)

    wet = float(ndtr(-motion.wet_above))
    each = wet * share(-np.inf) + (1.0 - wet) * share(np.inf)
    error = float(np.std(each) / np.sqrt(count) / np.mean(each))
    return Known(float(np.mean(each)), error, "products of misses, averaged over starts")


def _floors_sampled(motion: WetFloor) -> Known:
    """Plain rollouts of each floor."""
    wet = plain(replace(motion, wet_above=-np.inf), count=300_000, seed=SEED)
    dry = plain(replace(motion, wet_above=np.inf), count=2_000_000, seed=SEED)
    share = float(ndtr(-motion.wet_above))
    parts = [share * wet.value, (1.0 - share) * dry.value]
    errors = parts[0] * wet.relative_error, parts[1] * dry.relative_error
    return Known(sum(parts), float(np.hypot(*errors)) / sum(parts), "plain rollouts of each floor")


def enumerated(motion: Motion) -> Known:
    """A motion that misses alone decide: every sequence of outcomes, with its likelihood."""
    count = 2**motion.steps
    bits = np.arange(count)
    values = motion.begin(np.empty((count, 0)))
    failed, log_likelihood = motion.margin(values) < 0.0, np.zeros(count)
    for step in range(motion.steps):
        detected = (bits >> step) & 1 == 1
        logit = motion.logit(values)
        log_likelihood -= np.logaddexp(0.0, np.where(detected, -logit, logit))
        values = motion.move(values, step, detected, np.empty((count, 0)))
        failed |= motion.margin(values) < 0.0
    value = np.exp(log_likelihood[failed]).sum()
    return _formula(value, f"all {count:,} sequences of outcomes")


PLANAR = (
    "four-branch", "four-branch, rarer", "RP22", "RP24", "RP25", "RP28", "RP31", "RP35", "RP53",
    "RP57", "RP75", "RP89", "RP110", "RP111",
)  # fmt: skip
"""Of two standard normals."""


def _sampled_near(name: str, *starts: Sequence[float]) -> Way:
    return lambda: _near_design_points(name, np.array(starts))


MOTIONS: Mapping[str, Any] = {problem.name: problem.motion for problem in problems()}
PENDULUMS = {
    "pendulum": 20_000_000,
    "pendulum, discrete": 20_000_000,
    "pendulum, noisy sensor": 1_000_000,
}
"""By how many plain rollouts each is found again, half a minute of them."""
CARTS = tuple(name for name in MOTIONS if name.startswith("CartPole"))


def _pendulum(name: str, count: int) -> tuple[Way, ...]:
    """Where disturbances are few values, the probability is too rough in the state for a grid."""
    motion = MOTIONS[name]

    def sampled() -> Known:
        return plain(motion, count=count, seed=SEED)

    return (sampled,) if motion.forces else (lambda: _swinging(motion), sampled)


def _cart(name: str) -> tuple[Way, ...]:
    """Plain rollouts too where a million of them fail often enough to tell."""
    motion = MOTIONS[name]

    def windows() -> Known:
        return by_windows(motion, count=300_000, seed=SEED)

    def sampled() -> Known:
        return plain(motion, count=1_000_000, seed=SEED)

    if motion.starts:
        return (lambda: plain(motion, count=2_000_000, seed=SEED),)
    return {"CartPole, base 5": (windows, sampled), "CartPole, base 6": (windows,)}.get(
        name, (sampled,)
    )


def _walk(name: str) -> tuple[Way, ...]:
    return lambda: _pattern(MOTIONS[name]), lambda: enumerated(MOTIONS[name])


WAYS: Mapping[str, tuple[Way, ...]] = {
    **{name: _planar(name) for name in PLANAR},
    "RP75": (*_planar("RP75"), lambda: _formula(_bessel(3.0) / 2.0, "integral of K0 / pi")),
    "RP111": (*_planar("RP111"), lambda: _formula(_bessel(12.5), "integral of 2 K0 / pi")),
    "RP8": (_rp8, _sampled_near("RP8", [0, 0, 0, 0, 2, 2])),
    "RP14": (_rp14, _sampled_near("RP14", [-1, 0, 1, 0, 3])),
    "RP33": (
        lambda: _formula(_two_halves(3.0, 3.0, 1.0 / np.sqrt(3.0)), "normal of two variables"),
        _sampled_near("RP33", [2, 2, 2], [0, 0, 3]),
    ),
    "RP38": (_sampled_near("RP38", [1, 2, -2, 0, -1, 0, 0]),),
    "RP54": (
        lambda: _formula(stats.gamma(20).cdf(8.951), "gamma distribution"),
        lambda: _exponentials_sampled("RP54", 0.44, count=400_000),
    ),
    "RP55": (_rp55, lambda: by_column(_static("RP55"))),
    "RP60": (_rp60, lambda: plain(STATIC["RP60"], count=2_000_000, seed=SEED)),
    "RP63": (_rp63, _rp63_sampled),
    "RP77": (_rp77, _rp77_sampled),
    "RP91": (_sampled_near("RP91", [-3, 0, 0, 1, 0]),),
    "RP107": (
        lambda: _formula(ndtr(-5.0), "formula"),
        lambda: _linear_sampled("RP107", 5.0),
    ),
    "linear, 100": (
        lambda: _formula(ndtr(-6.0), "formula"),
        lambda: _linear_sampled("linear, 100", 6.0),
    ),
    "two planes, 100": (
        lambda: _formula(_two_halves(4.5, 5.0, 0.0), "formula"),
        _planes_sampled,
    ),
    "exponential sum, 100": (
        lambda: _formula(stats.gamma(100).sf(170.0), "gamma distribution"),
        lambda: _exponentials_sampled("exponential sum, 100", 1.72, count=200_000),
    ),
    "largest error, two-sided": (
        lambda: _largest(LargestError()),
        lambda: _largest_sampled(LargestError()),
    ),
    "sum of errors, two-sided": (
        lambda: _formula(2.0 * ndtr(-4.5), "formula"),
        lambda: _sum_sampled(SumOfErrors()),
    ),
    **{name: _pendulum(name, count) for name, count in PENDULUMS.items()},
    **{name: _cart(name) for name in CARTS},
    "InvertedPendulum-v5": (
        lambda: plain(MOTIONS["InvertedPendulum-v5"], count=10_000, seed=SEED),
    ),
    "robot, one wet floor in 1,000": (
        lambda: _floors(WetFloor()),
        lambda: _floors_sampled(WetFloor()),
    ),
    **{name: _walk(name) for name in MOTIONS if name.startswith("walk")},
}


def _bessel(limit: float) -> float:
    """P(|x1 x2| > limit) of two standard normals."""
    value, _ = integrate.quad(k0, limit, np.inf, epsabs=0.0, epsrel=1e-12)
    return 2.0 / np.pi * float(value)
