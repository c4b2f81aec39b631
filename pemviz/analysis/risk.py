"""The rate of harm that hazards add up to, its interval, and the factor that decides how far.

Factors are drawn, multiplied and added up; quantiles of the draws are the ends. Both ends are
carried apart where a factor has a range or a count: the lower one with the lower distributions, the
upper one with the upper ones.
"""

import math
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from pemviz.analysis.risk_factors import (
    HIGH,
    LOW,
    AnyFactor,
    Count,
    Draws,
    FactorKind,
    Side,
)
from pemviz.arrays import FloatArray

MOST_HOURS = 1e12
"""More than these count as out of reach."""


@dataclass(frozen=True)
class HazardFactors:
    """What harm from one hazard is the product of."""

    name: str
    encounters: AnyFactor
    violation: AnyFactor
    harm: AnyFactor

    @property
    def factors(self) -> tuple[AnyFactor, ...]:
        """All three."""
        return self.encounters, self.violation, self.harm


@dataclass(frozen=True)
class Interval:
    """A quantity with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class HazardRisk:
    """One hazard's factors, rates [1/h] and intervals."""

    name: str
    encounters_per_hour: Interval
    violation: Interval
    violations_per_hour: Interval
    harm: Interval
    harm_per_hour: Interval


@dataclass(frozen=True)
class FactorEffect:
    """What knowing one factor exactly would do.

    Attributes:
        factor: Which.
        hazards: Where it is a factor.
        high_if_known: Upper end of all harm, if it were known to be what it is taken for [1/h].
    """

    factor: AnyFactor
    hazards: tuple[str, ...]
    high_if_known: float

    @property
    def kind(self) -> FactorKind:
        """Of the factor."""
        return self.factor.kind


@dataclass(frozen=True)
class Risk:
    """What hazards add up to.

    Attributes:
        harm_per_hour: Of all hazards.
        violations_per_hour: Of all hazards.
        hazards: Each by itself.
    """

    harm_per_hour: Interval
    violations_per_hour: Interval
    hazards: tuple[HazardRisk, ...]


def combine(hazards: Sequence[HazardFactors], draws: Draws) -> Risk:
    """Rates of at least one hazard, with their intervals."""
    every = [(_part(one, draws), _part(one, draws, harm=False)) for one in hazards]
    total = _interval([harm for harm, _ in every])
    return Risk(
        harm_per_hour=total,
        violations_per_hour=_interval([violations for _, violations in every]),
        hazards=tuple(
            HazardRisk(
                name=one.name,
                encounters_per_hour=_of_factor(one.encounters, draws),
                violation=_of_factor(one.violation, draws),
                violations_per_hour=_interval([violations]),
                harm=_of_factor(one.harm, draws),
                harm_per_hour=_interval([harm]),
            )
            for one, (harm, violations) in zip(hazards, every, strict=True)
        ),
    )


@dataclass(frozen=True, eq=False)
class _Part:
    """A product: as far as known, and draws ``[N]`` for either end."""

    value: float
    lower: FloatArray
    upper: FloatArray


def _part(
    hazard: HazardFactors, draws: Draws, *, harm: bool = True, known: Collection[Hashable] = ()
) -> _Part:
    factors = hazard.factors if harm else hazard.factors[:2]

    def product(side: Side) -> FloatArray:
        found = np.ones(draws.count)
        for one in factors:
            found = found * (one.middle if one.key in known else one.drawn(draws, side))
        return found

    return _Part(math.prod(one.value for one in factors), product("lower"), product("upper"))


def _interval(parts: Sequence[_Part]) -> Interval:
    lower, upper = (
        sum(arrays) for arrays in zip(*((p.lower, p.upper) for p in parts), strict=True)
    )
    value = math.fsum(part.value for part in parts)
    return Interval(value, float(np.quantile(lower, LOW)), float(np.quantile(upper, HIGH)))


def _of_factor(factor: AnyFactor, draws: Draws) -> Interval:
    return Interval(factor.value, *factor.ends(draws))


def effects(hazards: Sequence[HazardFactors], draws: Draws) -> tuple[FactorEffect, ...]:
    """What knowing each quantity would do, the one that decides first; none of what is known."""
    parts = [_part(one, draws) for one in hazards]
    of_key: dict[Hashable, list[int]] = {}
    factors: dict[Hashable, AnyFactor] = {}
    for place, hazard in enumerate(hazards):
        for factor in hazard.factors:
            factors.setdefault(factor.key, factor)
            of_key.setdefault(factor.key, []).append(place)
    found = list[FactorEffect]()
    for key, factor in factors.items():
        low, high = factor.ends(draws)
        if low == high:
            continue
        changed = list(parts)
        for place in of_key[key]:
            changed[place] = _part(hazards[place], draws, known={key})
        names = tuple(dict.fromkeys(hazards[place].name for place in of_key[key]))
        found.append(FactorEffect(factor, names, _interval(changed).high))
    return tuple(sorted(found, key=lambda one: one.high_if_known))


def hours_needed(count: Count, *, high: float) -> float | None:
    """Hours in all after which a rate's upper 95 % end is at most ``high`` [h].

    If further hours have events as often as those so far; without events so far, if they have none
    either: chi^2_{0.975}(2 k + 2) / (2 T) with k = events T / hours. ``None``: never, or out of
    reach.
    """
    from scipy.optimize import brentq  # noqa: PLC0415  slow to import

    if count.events == 0:
        needed = float(gammaincinv(1.0, HIGH)) / high
        return max(needed, count.of) if needed <= MOST_HOURS else None
    rate = count.events / count.of
    if high <= rate:
        return None

    def excess(log_hours: float) -> float:
        hours = math.exp(log_hours)
        return float(gammaincinv(rate * hours + 1.0, HIGH)) / hours - high

    if excess(math.log(MOST_HOURS)) > 0.0:
        return None
    if excess(math.log(count.of)) <= 0.0:
        return count.of
    found = np.asarray(brentq(excess, math.log(count.of), math.log(MOST_HOURS)))
    return math.exp(float(found))
