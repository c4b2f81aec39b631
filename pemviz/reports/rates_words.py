"""Violations an hour or a kilometre of driving, and what lies between them."""

from collections.abc import Sequence
from dataclasses import dataclass

from pemviz.reports.estimate_words import level_text, no_interval_text
from pemviz.reports.numbers import UNKNOWN, digits_of, end_text
from pemviz.runs.rates import Rate, assumed_distance, assumed_encounters, rates
from pemviz.runs.result import RunResult
from pemviz.runs.trust import run_interval_caveats
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

LARGEST_PLAIN, LEAST_PLAIN = 1e6, 1e-3
"""Between them numbers are written without an exponent."""


@dataclass(frozen=True)
class Unit:
    """Of driving.

    Attributes:
        title: Over a table.
        each: With its article.
        between: Its plural.
        driving: The plural in a sentence.
    """

    title: str
    each: str
    between: str
    driving: str


HOUR = Unit("Per hour of driving", "an hour", "hours", "hours of driving")
KILOMETRE = Unit("Per kilometre of driving", "a kilometre", "kilometres", "kilometres of driving")


def unit_of(result: RunResult) -> Unit:
    """What a result's rates are per."""
    return HOUR if result.driven is None else KILOMETRE


def rate_columns(result: RunResult) -> tuple[str, ...]:
    """What :func:`rate_rows` gives."""
    unit = unit_of(result)
    return "violation of", unit.each, "interval", f"{unit.between} between two", "their interval"


def rate_line(result: RunResult) -> str:
    """The rate in all with its interval in a sentence; empty where there is none."""
    found, unit = rates(result), unit_of(result)
    if not found or result.estimate is None:
        return ""
    if result.driven is None:
        given = f"With {result.config.encounters_per_hour:g} encounters an hour"
        drawn = ", as the scenario draws them"
    else:
        given, drawn = f"With {result.driven.mean_km:.3g} km a rollout", ""
    _, value, interval, between, between_interval = rate_rows(result)[0]
    if found[0].between is None and found[0].high is None:
        return f"{given}: nothing is known of violations {unit.each}"
    if found[0].between is None:
        return f"{given}: no violation was seen; {unit.each} brings {interval} of them"
    if interval == UNKNOWN:
        ends = between_ends = "interval unknown"
    else:
        named = "" if run_interval_caveats(result) else f"{level_text(result.estimate)} interval "
        ends, between_ends = f"{named}{interval}", between_interval
    return (
        f"{given}{drawn}: {value} violations {unit.each} ({ends}), "
        f"one in {between} {unit.driving} ({between_ends})"
    )


def rate_rows(result: RunResult) -> list[tuple[str, ...]]:
    """What :func:`rate_columns` name: of all that is violated, then of each rule."""
    found = rates(result)
    if not found or result.estimate is None:
        return []
    every = "any rule" if result.rules else "the specification"
    rows = [(every, *_figures(found[0], result.estimate, run_interval_caveats(result)))]
    rows += [
        (rule.name, *_figures(rate, rule.estimate, interval_caveats(rule.estimate)))
        for rate, rule in zip(found[1:], result.rules, strict=True)
    ]
    return rows


def rate_note(result: RunResult) -> str:
    """What the rates take for granted; empty where there are none."""
    encounters = result.config.encounters_per_hour
    if result.driven is None and encounters is None:
        return ""
    words = "" if encounters is None else assumed_encounters(encounters)
    words = words if result.driven is None else assumed_distance(result.driven)
    return f"{words[0].upper()}{words[1:]}."


def _figures(rate: Rate, estimate: Estimate, caveats: Sequence[str]) -> tuple[str, str, str, str]:
    wrong = f", {no_interval_text(estimate)}" if caveats else ""
    digits = digits_of(rate.low, rate.high)
    ends = _range(rate.low, rate.high, digits)
    if rate.low is None and rate.high is not None:
        ends = f"at most {_quantity(rate.high, digits)}"
    units = _range(rate.between_low, rate.between_high, digits)
    if rate.between_low is not None and rate.between_high is None:
        units = f"at least {_quantity(rate.between_low, digits)}"
    between = "-" if rate.between is None else _quantity(rate.between, digits)
    found = "0: none was seen" if estimate.failures == 0 else _quantity(rate.value, digits)
    told = (f"{one}{wrong}" if one != UNKNOWN else one for one in (ends, units))
    of_rate, of_between = told
    return found, of_rate, between, of_between


def _range(low: float | None, high: float | None, digits: int) -> str:
    if low is None or high is None:
        return UNKNOWN
    return f"{_quantity(low, digits)} to {_quantity(high, digits)}"


def _quantity(value: float, digits: int) -> str:
    """With so many digits that count, as a plain number where that is readable."""
    rounded = float(f"{value:.{digits}g}")
    if rounded >= LARGEST_PLAIN or rounded < LEAST_PLAIN:
        return end_text(value, digits=digits)
    if rounded >= 10.0 ** (digits - 1):
        return f"{rounded:,.0f}"
    return end_text(value, digits=digits)
