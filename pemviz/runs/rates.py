"""From the probability of a violation in an encounter to violations an hour of driving."""

from dataclasses import dataclass

from pemviz.config.ranges import AtLeastZero
from pemviz.runs.result import RunResult
from pemviz.types import Estimate

LARGEST = 1e300
"""Of what is told, so that it and its inverse are float64."""


@dataclass(frozen=True)
class ViolationRate:
    """How many violations an hour of driving brings, with the ends of the interval.

    An encounter counts once, however often it violates. Hours are ``None`` where they are
    infinite or unknown.

    Attributes:
        rule: The rule's name; ``None``: the specification, or any rule.
        per_hour: Violations an hour [1/h]: the probability times the encounters an hour.
        low: At the lower end of the probability's interval.
        high: At its upper end.
        hours_between: Hours of driving between two violations, on average [h].
        hours_low: At the upper end of the probability's interval.
        hours_high: At its lower end.
    """

    rule: str | None
    per_hour: AtLeastZero
    low: AtLeastZero | None
    high: AtLeastZero | None
    hours_between: AtLeastZero | None
    hours_low: AtLeastZero | None
    hours_high: AtLeastZero | None


def violation_rates(result: RunResult) -> tuple[ViolationRate, ...]:
    """The rate of violations, then of each rule's; none unless encounters an hour are told."""
    encounters = result.config.encounters_per_hour
    if encounters is None or result.estimate is None:
        return ()
    rules = [_rate(rule.name, rule.estimate, encounters) for rule in result.rules]
    return (_rate(None, result.estimate, encounters), *rules)


def _rate(rule: str | None, estimate: Estimate, encounters: float) -> ViolationRate:
    per_hour = min(estimate.probability * encounters, LARGEST)
    low, high = (
        None if end is None else min(end * encounters, LARGEST)
        for end in (estimate.ci_low, estimate.ci_high)
    )
    return ViolationRate(
        rule=rule,
        per_hour=per_hour,
        low=low,
        high=high,
        hours_between=_hours(per_hour),
        hours_low=_hours(high),
        hours_high=_hours(low),
    )


def _hours(per_hour: float | None) -> float | None:
    return None if per_hour is None or per_hour < 1.0 / LARGEST else 1.0 / per_hour


def assumed_encounters(encounters_per_hour: float) -> str:
    """What a rate takes for granted, in words."""
    return (
        f"an hour of driving holds {encounters_per_hour:g} encounters on average, all of them as "
        "the scenario draws them; what else happens on the road is not counted"
    )
