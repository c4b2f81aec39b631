"""What is known of the factors of a risk: distributions that intervals and counts stand for.

A count's exact interval is that of two distributions: its lower end that of one, its upper end that
of the other (the Poisson one of Garwood 1936 with gamma distributions, the binomial one of Clopper
and Pearson 1934 with beta distributions). Both are carried, so that what comes of a count alone
is its exact interval, and of none seen there is an upper end. A stated interval is log-normal to
either side of its median. What is a range and no distribution, as over memories of misses, has an
end to either side and is never averaged over.
"""

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from scipy.special import betaincinv, expit, gammaincinv, ndtri, stdtrit

from pemviz.arrays import BoolArray, FloatArray, IntArray, row_sums

Side = Literal["lower", "upper"]
FactorKind = Literal["encounters", "violation", "harm"]
LOW, HIGH = 0.025, 0.975
Z95 = float(ndtri(HIGH))
DRAWS = 100_000
MOST_SPEEDS = 200
"""Groups of impact speeds."""
AT_ONCE = 10_000
"""Draws of a curve at a time."""


class Distribution(Protocol):
    """A distribution of a quantity at or above 0."""

    def at(self, share: FloatArray) -> FloatArray:
        """Quantiles ``[N]`` at shares ``[N]`` from 0 to 1."""
        ...


@dataclass(frozen=True)
class Exact:
    """Known exactly, or an end of what is no distribution."""

    value: float

    def at(self, share: FloatArray) -> FloatArray:
        """The value."""
        return np.full_like(share, self.value)


@dataclass(frozen=True)
class LogNormal:
    """Log-normal to either side of the median, by the ends of its 95 % interval, up to ``most``."""

    median: float
    low: float
    high: float
    most: float = math.inf

    def at(self, share: FloatArray) -> FloatArray:
        """Quantiles."""
        z, log_median = ndtri(share), math.log(self.median)
        below, above = log_median - math.log(self.low), math.log(self.high) - log_median
        spread = np.where(z < 0.0, below, above) / Z95
        return np.minimum(np.exp(log_median + spread * z), self.most)


@dataclass(frozen=True)
class Gamma:
    """Gamma, of a rate: ``events`` in ``hours`` [1/h]; 0 of no events."""

    events: float
    hours: float

    def at(self, share: FloatArray) -> FloatArray:
        """Quantiles."""
        if self.events == 0.0:
            return np.zeros_like(share)
        return np.asarray(gammaincinv(self.events, share)) / self.hours


@dataclass(frozen=True)
class Beta:
    """Beta, of a probability; 0 without ``events``, 1 without ``others``."""

    events: float
    others: float

    def at(self, share: FloatArray) -> FloatArray:
        """Quantiles."""
        if self.events == 0.0 or self.others == 0.0:
            return np.full_like(share, 0.0 if self.events == 0.0 else 1.0)
        return np.asarray(betaincinv(self.events, self.others, share))


class Draws:
    """Shares from 0 to 1 of each quantity that is not known, stratified, the same for the same key.

    One draw lies in each of N equal parts (Latin hypercube sampling, McKay, Beckman and Conover
    1979): of a single quantity quantiles are then as good as exact.
    """

    def __init__(self, *, count: int = DRAWS, seed: int = 0) -> None:
        """So many draws."""
        self.count = count
        self._seed = seed
        self._shares: dict[Hashable, FloatArray] = {}
        self._values: dict[Hashable, FloatArray] = {}

    def share(self, key: Hashable) -> FloatArray:
        """Shares ``[N]`` of the quantity ``key``; which is asked first has the seed's first."""
        if key not in self._shares:
            sequence = np.random.SeedSequence(self._seed, spawn_key=(len(self._shares),))
            random = np.random.default_rng(sequence)
            part = random.permutation(self.count) + random.random(self.count)
            self._shares[key] = np.clip(part / self.count, 1e-12, 1.0 - 1e-12)
        return self._shares[key]

    def once(self, key: Hashable, values: Callable[[], FloatArray]) -> FloatArray:
        """Values ``[N]`` that are computed when they are first asked for."""
        if key not in self._values:
            self._values[key] = values()
        return self._values[key]


@dataclass(frozen=True)
class Count:
    """What a factor was counted from, where it was.

    ``of``: hours driven [h], or trials.
    """

    events: int
    of: float


@dataclass(frozen=True)
class Factor:
    """A factor of a risk.

    Attributes:
        kind: Which.
        value: As far as it is known.
        lower: What its lower end comes from.
        upper: What its upper end comes from.
        source: Where it is from. Two factors that are equal are one quantity, drawn once.
        count: What it was counted from, where it was.
        drawn_with: Names what several quantities come from, such as the rollouts of one run: they
            are then drawn as if one were high whenever the other is, which is the worst for sums.
    """

    kind: FactorKind
    value: float
    lower: Distribution
    upper: Distribution
    source: str
    count: Count | None = None
    drawn_with: str = ""

    @property
    def key(self) -> Hashable:
        """What tells it from other quantities."""
        return self

    @property
    def middle(self) -> float:
        """What it is taken for where it is taken as known; of no events half the time more."""
        return self.value or float(self.upper.at(np.array([0.5]))[0])

    def ends(self, draws: Draws) -> tuple[float, float]:
        """Of its 95 % interval."""
        del draws
        return float(self.lower.at(np.array([LOW]))[0]), float(self.upper.at(np.array([HIGH]))[0])

    def drawn(self, draws: Draws, side: Side) -> FloatArray:
        """Values ``[N]``."""
        one = self.lower if side == "lower" else self.upper
        shared = self.drawn_with or self.key
        return draws.once((shared, one), lambda: one.at(draws.share(shared)))


@dataclass(frozen=True)
class InjuryCurve:
    """P(harm) = 1 / (1 + exp(-(intercept + slope v))), v the closing speed [m/s].

    Attributes:
        intercept: And its standard error.
        slope: Per m/s of closing speed, and its standard error.
        correlation: Of both estimates.
        source: Where it is from.
    """

    intercept: float
    slope: float
    intercept_std_error: float
    slope_std_error: float
    correlation: float
    source: str

    def coefficients(self, draws: Draws) -> tuple[FloatArray, FloatArray]:
        """Intercepts and slopes ``[N]``, jointly normal."""
        first, second = (ndtri(draws.share((self, name))) for name in ("intercept", "slope"))
        own = math.sqrt(1.0 - self.correlation**2)
        moved = self.correlation * first + own * second
        return (
            self.intercept + self.intercept_std_error * first,
            self.slope + self.slope_std_error * moved,
        )


@dataclass(frozen=True)
class ImpactSpeeds:
    """Closing speeds at impact of violating rollouts, in groups.

    Attributes:
        speed_mps: Of each group; 0 also where nothing is hit.
        share: Of the violations, by weight; 1 together.
        squares: Sum of squares of the single rollouts' shares in each group.
        hits: Whether something is hit.
        runs: Of particles that have ancestors in common: the share of each group in each of the
            independent runs; empty of independent rollouts.
    """

    speed_mps: tuple[float, ...]
    share: tuple[float, ...]
    squares: tuple[float, ...]
    hits: tuple[bool, ...]
    runs: tuple[tuple[float, ...], ...] = ()

    @property
    def hit_share(self) -> float:
        """The share of violations in which something is hit."""
        return math.fsum(s for s, hit in zip(self.share, self.hits, strict=True) if hit)

    @property
    def independent(self) -> float:
        """How many independent violations these are worth: runs of particles, else 1 / sum w^2."""
        squares = math.fsum(self.squares)
        return float(len(self.runs)) if self.runs else 1.0 / squares if squares else math.inf

    def quantile(self, share: float) -> float:
        """Of the speeds of those that hit [m/s]; 0 if none does."""
        total, wanted = 0.0, share * self.hit_share
        found = 0.0
        for speed, part, hit in zip(self.speed_mps, self.share, self.hits, strict=True):
            if hit and total < wanted:
                found, total = speed, total + part
        return found


def impact_speeds(
    speed_mps: FloatArray, *, hit: BoolArray, weight: FloatArray, run: IntArray | None = None
) -> ImpactSpeeds:
    """Groups of violating rollouts ``[V]`` with speeds [m/s], whether they hit, and weights.

    Groups are of equal width in speed, each at its mean by weight: so many that a curve does not
    tell the difference. ``run`` numbers the independent run of each, where rollouts are particles.
    """
    share = weight / float(np.sum(weight))
    width = max(float(speed_mps.max(initial=0.0)), 1e-9) / MOST_SPEEDS
    group = np.where(hit, 1 + np.minimum(speed_mps // width, MOST_SPEEDS - 1), 0).astype(np.int64)
    total = np.bincount(group, share)
    used = np.flatnonzero(total)
    mean = np.bincount(group, share * np.where(hit, speed_mps, 0.0))[used] / total[used]
    of_run = () if run is None else (run == number for number in np.unique(run).tolist())
    parts = (np.bincount(group[own], share[own], minlength=total.size)[used] for own in of_run)
    return ImpactSpeeds(
        speed_mps=tuple(mean.tolist()),
        share=tuple(total[used].tolist()),
        squares=tuple(np.bincount(group, share**2)[used].tolist()),
        hits=tuple((used > 0).tolist()),
        runs=tuple(tuple(part.tolist()) for part in parts),
    )


@dataclass(frozen=True)
class CurveHarm:
    """P(harm | violation) by a curve over impact speeds; without a hit there is no harm.

    The coefficients are drawn, once for all hazards with the same curve, and so is the error of the
    average over a finite number of violating rollouts (delta method, on a logarithmic scale; of
    particles by what differs between runs, with Student's t).

    Attributes:
        curve: With the errors of its coefficients.
        speeds: Impact speeds that the upper end comes from, and the value.
        source: Where the curve is from.
        lower: Those that the lower end comes from, where they are of another run.
    """

    curve: InjuryCurve
    speeds: ImpactSpeeds
    source: str
    lower: ImpactSpeeds | None = None
    kind: FactorKind = "harm"
    count: Count | None = field(default=None, init=False)

    @property
    def key(self) -> Hashable:
        """The curve: hazards share it."""
        return self.curve

    @property
    def value(self) -> float:
        """With the coefficients as they are."""
        one = np.ones(1)
        return float(self._mean(one * self.curve.intercept, one * self.curve.slope)[0][0])

    @property
    def middle(self) -> float:
        """The same."""
        return self.value

    def ends(self, draws: Draws) -> tuple[float, float]:
        """Of its 95 % interval."""
        lower, upper = self.drawn(draws, "lower"), self.drawn(draws, "upper")
        return float(np.quantile(lower, LOW)), float(np.quantile(upper, HIGH))

    def drawn(self, draws: Draws, side: Side) -> FloatArray:
        """Values ``[N]``."""
        if side == "lower" and self.lower is not None:
            return CurveHarm(self.curve, self.lower, self.source).drawn(draws, side)
        return draws.once((self.curve, self.speeds, "harm"), lambda: self._drawn(draws))

    def _drawn(self, draws: Draws) -> FloatArray:
        mean, error = self._mean(*self.curve.coefficients(draws))
        relative = np.divide(error, mean, out=np.zeros_like(mean), where=mean > 0.0)
        share, runs = draws.share((self.curve, self.speeds)), len(self.speeds.runs)
        z = np.asarray(stdtrit(runs - 1, share)) if runs > 1 else ndtri(share)
        return np.minimum(mean * np.exp(relative * z), 1.0)

    def _mean(self, intercept: FloatArray, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """P(harm) over the violations, and its standard error, for coefficients ``[N]``."""
        speed, share = np.array(self.speeds.speed_mps), np.array(self.speeds.share)
        squares, hits = np.array(self.speeds.squares), np.array(self.speeds.hits)
        runs = np.array(self.speeds.runs)
        means, errors = list[FloatArray](), list[FloatArray]()
        for first in range(0, intercept.size, AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            risk = hits * expit(intercept[rows, np.newaxis] + slope[rows, np.newaxis] * speed)
            mean = row_sums(risk * share)
            means.append(mean)
            beyond = risk - mean[:, np.newaxis]
            if len(runs) > 1:
                between = row_sums((beyond @ runs.T) ** 2) * len(runs) / (len(runs) - 1)
                errors.append(np.sqrt(between))
            else:
                errors.append(np.sqrt(row_sums(beyond**2 * squares)))
        return np.concatenate(means), np.concatenate(errors)


AnyFactor = Factor | CurveHarm


def counted_rate(events: int, hours: float, *, source: str) -> Factor:
    """A rate [1/h] by the exact Poisson interval."""
    upper = Gamma(events + 1.0, hours)
    lower, count = Gamma(float(events), hours), Count(events, hours)
    return Factor("encounters", events / hours, lower, upper, source, count)


def counted_probability(events: int, trials: int, *, kind: FactorKind, source: str) -> Factor:
    """A probability by the exact binomial interval."""
    others = trials - events
    lower, upper = Beta(float(events), others + 1.0), Beta(events + 1.0, float(others))
    return Factor(kind, events / trials, lower, upper, source, Count(events, trials))


def stated(
    median: float, low: float, high: float, *, kind: FactorKind, source: str, most: float = math.inf
) -> Factor:
    """A quantity by its median and its 95 % interval."""
    both = LogNormal(median, low, high, most) if low < high else Exact(median)
    return Factor(kind, median, both, both, source)
