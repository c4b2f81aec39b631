"""From the probability of a violation to violations an hour of driving, or a kilometre of it."""

import math
from dataclasses import astuple, dataclass

from pemviz.config.ranges import AtLeastZero
from pemviz.runs.result import DrivenDistance, RunResult
from pemviz.types import Estimate

LARGEST = 1e300
"""Of what is reported, so that it and its inverse are float64."""
LARGEST_LOG = 690.0
"""Of what an end of an interval is multiplied with."""
Z95 = 1.96


@dataclass(frozen=True)
class ViolationRate:
    """How many violations an hour of driving brings, as ``result.json`` has it; see :class:`Rate`.

    An encounter counts once, however often it violates.

    Attributes:
        rule: The rule's name; ``None``: the specification, or any rule.
        per_hour: Violations an hour of driving [1/h].
        low: The lower end, of the interval of all that is not known [1/h].
        high: The upper end [1/h].
        hours_between: Hours of driving between two violations, on average [h].
        hours_low: At the upper end of the rate [h].
        hours_high: At its lower end [h].
    """

    rule: str | None
    per_hour: AtLeastZero
    low: AtLeastZero | None
    high: AtLeastZero | None
    hours_between: AtLeastZero | None
    hours_low: AtLeastZero | None
    hours_high: AtLeastZero | None


@dataclass(frozen=True)
class DistanceRate:
    """How many violations a kilometre brings, as ``result.json`` has it; see :class:`Rate`.

    A rollout counts once, however often it violates.

    Attributes:
        rule: The rule's name; ``None``: the specification, or any rule.
        per_km: Violations a kilometre [1/km].
        low: The lower end, of the interval of all that is not known [1/km].
        high: The upper end [1/km].
        km_between: Kilometres between two violations, on average [km].
        km_low: At the upper end of the rate [km].
        km_high: At its lower end [km].
    """

    rule: str | None
    per_km: AtLeastZero
    low: AtLeastZero | None
    high: AtLeastZero | None
    km_between: AtLeastZero | None
    km_low: AtLeastZero | None
    km_high: AtLeastZero | None


@dataclass(frozen=True)
class Rate:
    """A rate of either kind; units between violations are ``None`` where infinite or unknown.

    Attributes:
        rule: The rule's name; ``None``: the specification, or any rule.
        value: Violations per unit: the probability times the encounters an hour [1/h], or over the
            distance of a rollout [1/km].
        low: The lower end, of the interval of all that is not known.
        high: The upper end.
        between: Units of driving between two violations, on average [h or km].
        between_low: At the upper end of the rate.
        between_high: At its lower end.
    """

    rule: str | None
    value: float
    low: float | None
    high: float | None
    between: float | None
    between_low: float | None
    between_high: float | None


def rates(result: RunResult) -> tuple[Rate, ...]:
    """The rate of violations, then of each rule's, per hour or km; none without either."""
    if result.estimate is None:
        return ()
    encounters, driven = result.config.encounters_per_hour, result.driven
    estimates = [(None, result.estimate), *((rule.name, rule.estimate) for rule in result.rules)]
    if driven is not None:
        return tuple(_over_distance(rule, estimate, driven) for rule, estimate in estimates)
    if encounters is None:
        return ()
    return tuple(
        _rate(rule, estimate.probability, estimate.ci_low, estimate.ci_high, encounters)
        for rule, estimate in estimates
    )


def violation_rates(result: RunResult) -> tuple[ViolationRate, ...]:
    """Rates an hour; none unless encounters an hour are given."""
    if result.driven is not None:
        return ()
    return tuple(ViolationRate(*astuple(rate)) for rate in rates(result))


def distance_rates(result: RunResult) -> tuple[DistanceRate, ...]:
    """Rates a kilometre; none unless a rollout is a stretch of driving."""
    if result.driven is None:
        return ()
    return tuple(DistanceRate(*astuple(rate)) for rate in rates(result))


def _over_distance(rule: str | None, estimate: Estimate, driven: DrivenDistance) -> Rate:
    """The probability over the distance; relative errors of both add up as independent ones."""
    relative = Z95 * driven.std_error_km / driven.mean_km
    low, high = estimate.ci_low, estimate.ci_high
    if estimate.probability > 0.0 and low is not None and low > 0.0:
        width = math.log(estimate.probability) - math.log(low)
        low *= math.exp(-(math.hypot(width, relative) - width))
    if estimate.probability > 0.0 and high is not None and high > 0.0:
        width = math.log(high) - math.log(estimate.probability)
        high *= math.exp(min(math.hypot(width, relative) - width, LARGEST_LOG))
    return _rate(rule, estimate.probability, low, high, 1.0 / driven.mean_km)


def _rate(
    rule: str | None, probability: float, low: float | None, high: float | None, times: float
) -> Rate:
    value = min(probability * times, LARGEST)
    least, most = (None if end is None else min(end * times, LARGEST) for end in (low, high))
    return Rate(rule, value, least, most, _inverse(value), _inverse(most), _inverse(least))


def _inverse(rate: float | None) -> float | None:
    return None if rate is None or rate < 1.0 / LARGEST else 1.0 / rate


def assumed_encounters(encounters_per_hour: float) -> str:
    """What a rate an hour takes for granted, in words."""
    return (
        f"an hour of driving holds {encounters_per_hour:g} encounters on average, all of them as "
        "the scenario draws them; what else happens on the road is not counted"
    )


def assumed_distance(driven: DrivenDistance) -> str:
    """What a rate a kilometre rests on, in words."""
    return (
        f"a rollout is {driven.mean_km:.3g} km of driving on average (+- "
        f"{driven.std_error_km / driven.mean_km:.1%}, by {driven.rollouts} rollouts of the error "
        "model's own), and counts once however often it violates"
    )
