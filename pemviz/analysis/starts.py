"""Which starts are dangerous: those of violations against all that the scenario draws.

How all starts are distributed is known, for latents are standard normal. Those of violations come
from the rollouts that the answer rests on, each with its part c_i of the probability p. In the
plane of two start values, with a kernel k (Epanechnikov 1969) around a point x,

    P(violation | start near x) = sum_i c_i k(x_i - x) / E k(X - x)

where X are all starts: the average of P(violation | start) over the starts within the kernel's
reach, which shrinks as violations grow in number; nothing beyond counts. It is shown where at least
ten effective violations lie within it, so that its standard error stays below a third.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray
from pemviz.config.ranges import AtLeastZero, Count, Log10
from pemviz.simulators.latents import NamesStarts, latent_counts

DRAWN = 2**15
WIDE, WIDE_SHARE = 2.0, 0.3
"""Latents of all starts are sampled with this standard deviation in this share, for the tails."""
SHARES = (0.1, 0.5, 0.9)
"""Of what lies at or below the quantiles that are shown."""
FEWEST = 10.0
"""Effective violations below which nothing is shown."""
FEWEST_OF_MAP = 25.0
"""The same for the plane: from fewer, single weights would draw its outline."""
GRID = 32
OUTER = 0.005
"""Share of all starts that may lie beyond either side of the plane."""
REACH = 5.0**0.5
"""Of the kernel, in standard deviations of it."""
MOST_POINTS = 200
SHIFTED = 0.25
"""Deviations from which on a value counts as shifted."""


@dataclass(frozen=True)
class WeightedStarts:
    """A sample of start values.

    Attributes:
        values: By name, ``[N]``.
        share: ``[N]``, summing to 1; what has the same latents counts as one.
    """

    values: Mapping[str, FloatArray]
    share: FloatArray

    @property
    def effective(self) -> float:
        """Effective sample size (Kong 1992)."""
        return float(1.0 / np.sum(self.share**2)) if self.share.size else 0.0

    def quantiles(self, name: str, shares: Sequence[float]) -> FloatArray:
        """The least values that at least these shares lie at or below, ``[K]``."""
        order = np.argsort(self.values[name], kind="stable")
        below = np.cumsum(self.share[order])
        place = np.searchsorted(below, np.asarray(shares) * below[-1], side="left")
        return self.values[name][order][np.minimum(place, order.size - 1)]

    def below(self, name: str, value: float) -> float:
        """The share that lies below a value, of what is equal to it half."""
        values = self.values[name]
        return float(np.sum(self.share[values < value]) + 0.5 * np.sum(self.share[values == value]))

    def interval(self, name: str, share: float) -> tuple[float, float]:
        """Where the quantile lies with 95 % (Woodruff 1952), from the weights' own spread."""
        at_or_below = self.values[name] <= self.quantiles(name, (share,))[0]
        error = float(np.sqrt(np.sum((self.share * (at_or_below - share)) ** 2)))
        ends = (max(share - 1.96 * error, 0.0), min(share + 1.96 * error, 1.0))
        low, high = self.quantiles(name, ends)
        return float(low), float(high)


def all_starts(simulator: NamesStarts) -> WeightedStarts:
    """What the scenario draws, by as many starts as show its tails; the same every time.

    Raises:
        ConfigError: The simulator's own, of values that it cannot map.
    """
    columns = latent_counts(simulator).start
    generator = np.random.default_rng(0)
    wide = generator.random((DRAWN, columns)) < WIDE_SHARE
    z = generator.standard_normal((DRAWN, columns)) * np.where(wide, WIDE, 1.0)
    drawn = (1.0 - WIDE_SHARE) * np.exp(-0.5 * z**2)
    drawn += WIDE_SHARE / WIDE * np.exp(-0.5 * (z / WIDE) ** 2)
    weight = np.prod(np.exp(-0.5 * z**2) / drawn, axis=1)
    return WeightedStarts(_named(simulator, z), weight / np.sum(weight))


def violating_starts(
    simulator: NamesStarts, *, latents: FloatArray, log_share: FloatArray
) -> WeightedStarts:
    """Those of violations; copies of a start, as splitting's particles are, count as one.

    Latents are ``[V, S]``; ``log_share [V]`` is what each contributes, up to a factor.
    """
    kept = np.isfinite(log_share)
    latents, log_share = latents[kept], log_share[kept]
    if not log_share.size:
        return WeightedStarts(_named(simulator, latents), np.empty(0))
    share = np.exp(log_share - np.max(log_share))
    distinct, group = np.unique(latents, axis=0, return_inverse=True)
    total = np.bincount(group.ravel(), weights=share, minlength=len(distinct))
    return WeightedStarts(_named(simulator, distinct), total / np.sum(total))


def deviations(share: float) -> float:
    """Where a normal value lies that this share is below, in standard deviations; 6 at most."""
    return float(np.clip(ndtri(np.clip(share, 1e-12, 1.0 - 1e-12)), -6.0, 6.0))


def _named(simulator: NamesStarts, latents: FloatArray) -> Mapping[str, FloatArray]:
    values = simulator.start_values(latents)
    return {name: np.asarray(one, dtype=np.float64) for name, one in values.items()}


@dataclass(frozen=True)
class QuantileRange:
    """A quantile with its 95 % interval, in the value's unit.

    Attributes:
        value: The quantile.
        low: Lower end of the interval.
        high: Upper end.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class StartValue:
    """One start value, of all starts and of those that violate.

    Attributes:
        name: As the scenario names it.
        unit: Its unit.
        all_starts: Quantiles at :data:`SHARES`.
        violations: The same of violations; empty where these are too few.
        shift: Where the violations' median lies among all starts, in standard deviations of a
            normal: 0 in the middle, above 0 where violations start with more of it.
    """

    name: str
    unit: str
    all_starts: tuple[float, ...]
    violations: tuple[QuantileRange, ...]
    shift: float | None


@dataclass(frozen=True)
class StartMap:
    """P(violation | start) over the plane of two start values.

    Attributes:
        across: The value to the right, by name.
        up: The value upwards.
        across_low: Centre of the first column, in its unit.
        across_high: Of the last.
        up_low: Centre of the first row.
        up_high: Of the last.
        across_reach: How far the kernel reaches to either side.
        up_reach: Likewise.
        log10_probability: Rows from below, of columns from the left; ``None`` where the violations
            are too few to tell.
    """

    across: str
    up: str
    across_low: float
    across_high: float
    up_low: float
    up_high: float
    across_reach: AtLeastZero
    up_reach: AtLeastZero
    log10_probability: tuple[tuple[Log10 | None, ...], ...]


@dataclass(frozen=True)
class StartPoint:
    """A violating rollout in the plane; the likelier, the more points a part of the plane has.

    Attributes:
        repetition: Zero-based.
        stage: Its stage.
        rollout: Its index in the stage.
        across: Its value to the right.
        up: Its value upwards.
    """

    repetition: Count
    stage: Count
    rollout: Count
    across: float
    up: float


@dataclass(frozen=True)
class DangerousStarts:
    """The starts of violations against all starts.

    Attributes:
        rule: Whose violations; ``None``: of the specification, or of any rule.
        violations: Rollouts that violate.
        effective: Effective sample size of the violations' different starts.
        log10_probability: Of a violation, on average over all starts.
        values: Each start value.
        plane: ``None`` where violations are too few, or one of its values is always the same.
        points: Violating rollouts, drawn by what they contribute.
    """

    rule: str | None
    violations: Count
    effective: AtLeastZero
    log10_probability: Log10
    values: tuple[StartValue, ...]
    plane: StartMap | None = None
    points: tuple[StartPoint, ...] = ()

    def shifted(self) -> tuple[StartValue, ...]:
        """Values by how far violations lie from all starts, the farthest first."""
        far = [one for one in self.values if one.shift is not None and abs(one.shift) >= SHIFTED]
        return tuple(sorted(far, key=lambda one: -abs(one.shift or 0.0)))


@dataclass(frozen=True)
class Violations(Batch):
    """Violating rollouts, with what they start from and contribute.

    Attributes:
        latents: Their start latents, ``[V, S]``.
        log_part: Log of each one's part of the probability, ``[V]``.
        place: Repetition, stage and rollout, ``[V, 3]``.
        broken: Which rules each breaks, ``[V]`` by name, where there are rules.
    """

    latents: FloatArray
    log_part: FloatArray
    place: IntArray
    broken: Mapping[str, BoolArray]

    def under_rule(self, rule: str) -> "Violations":
        """Those that break one rule."""
        rows = self.broken[rule]
        return Violations(self.latents[rows], self.log_part[rows], self.place[rows], {})


def dangerous_starts(
    simulator: NamesStarts, violations: Violations, *, rules: Sequence[str] = ()
) -> tuple[DangerousStarts, ...]:
    """Of violations in all, then of each rule's; none where no violation was seen.

    Violations are of all rollouts that the estimate averages.
    """
    drawn = all_starts(simulator)
    kinds = [(None, violations), *((rule, violations.under_rule(rule)) for rule in rules)]
    return tuple(
        _of_violations(simulator, drawn, kind, rule=rule)
        for rule, kind in kinds
        if np.any(np.isfinite(kind.log_part))
    )


def _of_violations(
    simulator: NamesStarts, drawn: WeightedStarts, violations: Violations, *, rule: str | None
) -> DangerousStarts:
    log_part = violations.log_part
    sample = violating_starts(simulator, latents=violations.latents, log_share=log_part)
    largest = float(np.max(log_part))
    log_probability = largest + float(np.log(np.sum(np.exp(log_part - largest))))
    log10 = log_probability / float(np.log(10.0))
    return DangerousStarts(
        rule=rule,
        violations=int(log_part.size),
        effective=sample.effective,
        log10_probability=log10,
        values=tuple(
            _start_value(signal.name, signal.unit, drawn, sample, known=sample.effective >= FEWEST)
            for signal in simulator.starts
        ),
        plane=(
            _start_map(simulator, drawn, sample, log10_probability=log10)
            if sample.effective >= FEWEST_OF_MAP
            else None
        ),
        points=_points(simulator, violations) if rule is None else (),
    )


def _start_value(
    name: str, unit: str, drawn: WeightedStarts, sample: WeightedStarts, *, known: bool
) -> StartValue:
    ranges: list[QuantileRange] = []
    shift = None
    if known:
        for value, share in zip(sample.quantiles(name, SHARES).tolist(), SHARES, strict=True):
            ranges.append(QuantileRange(value, *sample.interval(name, share)))
        shift = deviations(drawn.below(name, float(sample.quantiles(name, (0.5,))[0])))
    every = tuple(float(value) for value in drawn.quantiles(name, SHARES))
    return StartValue(name, unit, every, tuple(ranges), shift)


def _start_map(
    simulator: NamesStarts,
    drawn: WeightedStarts,
    sample: WeightedStarts,
    *,
    log10_probability: float,
) -> StartMap | None:
    """The map; ``None`` without a plane. The probability is that of a violation over all starts."""
    axes = [_axis(name, drawn, sample) for name in simulator.start_plane]
    if any(reach == 0.0 for _, reach in axes):
        return None
    kernels = [
        tuple(_kernel(places, one.values[name], reach) for one in (drawn, sample))
        for (places, reach), name in zip(axes, simulator.start_plane, strict=True)
    ]
    (across_drawn, across_sample), (up_drawn, up_sample) = kernels
    every = (up_drawn * drawn.share) @ across_drawn.T
    parts = (up_sample * sample.share) @ across_sample.T
    squares = ((up_sample * sample.share) ** 2) @ (across_sample**2).T
    of_all = ((up_drawn * drawn.share) ** 2) @ (across_drawn**2).T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
        known = (parts**2 >= FEWEST * squares) & (every**2 >= FEWEST * of_all) & (squares > 0.0)
        log10 = np.minimum(log10_probability + np.log10(parts) - np.log10(every), 0.0)
    (across, across_reach), (up, up_reach) = axes
    return StartMap(
        *simulator.start_plane,
        across_low=float(across[0]),
        across_high=float(across[-1]),
        up_low=float(up[0]),
        up_high=float(up[-1]),
        across_reach=across_reach,
        up_reach=up_reach,
        log10_probability=tuple(
            tuple(round(float(v), 3) if k else None for v, k in zip(row, of_row, strict=True))
            for row, of_row in zip(log10, known, strict=True)
        ),
    )


def _axis(name: str, drawn: WeightedStarts, sample: WeightedStarts) -> tuple[FloatArray, float]:
    """Centres ``[GRID]``, and the kernel's reach: Scott's (1992) for two dimensions."""
    values = sample.values[name]
    spread = float(np.sqrt(np.sum(sample.share * (values - np.sum(sample.share * values)) ** 2)))
    all_low, all_high = drawn.quantiles(name, (OUTER, 1.0 - OUTER))
    low, high = sample.quantiles(name, (OUTER, 1.0 - OUTER))
    low, high = min(float(all_low), float(low)), max(float(all_high), float(high))
    if not high > low or spread <= 1e-9 * (high - low):
        return np.array([low, high]), 0.0
    return np.linspace(low, high, GRID), REACH * spread * sample.effective ** (-1.0 / 6.0)


def _kernel(places: FloatArray, values: FloatArray, reach: float) -> FloatArray:
    """The kernel at ``places [G]`` of values ``[N]``, ``[G, N]``; 0 beyond its reach."""
    return np.maximum(1.0 - ((places[:, None] - values) / reach) ** 2, 0.0)


def _points(simulator: NamesStarts, violations: Violations) -> tuple[StartPoint, ...]:
    """At most so many as are sampled: evenly along their parts of the probability."""
    log_part = violations.log_part
    share = np.exp(log_part - np.max(log_part))
    passed = np.cumsum(share)
    marks = (np.arange(MOST_POINTS) + 0.5) / MOST_POINTS * passed[-1]
    rows = np.unique(np.searchsorted(passed, marks))
    values = simulator.start_values(violations.latents[rows])
    across, up = (values[name] for name in simulator.start_plane)
    return tuple(
        StartPoint(int(repetition), int(stage), int(rollout), float(x), float(y))
        for (repetition, stage, rollout), x, y in zip(
            violations.place[rows], across, up, strict=True
        )
    )
