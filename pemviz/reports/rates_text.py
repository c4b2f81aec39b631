"""Violations an hour of driving, and the hours between them, in words and rows."""

from collections.abc import Sequence

from pemviz.reports.digits import digits_of, end_text
from pemviz.reports.escape import markdown_table, markdown_text
from pemviz.reports.estimate_text import level_text, no_interval_text
from pemviz.runs.rates import ViolationRate, assumed_encounters, violation_rates
from pemviz.runs.result import RunResult
from pemviz.runs.trust import run_interval_caveats
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

RATES_TITLE = "Per hour of driving"
RATE_COLUMNS = ("violation of", "an hour", "interval", "hours between two", "their interval")
LARGEST_PLAIN, LEAST_PLAIN = 1e6, 1e-3
"""Between them numbers are written without an exponent."""


def rate_line(result: RunResult) -> str:
    """The rate in all with its interval in a sentence; empty without encounters an hour."""
    rates = violation_rates(result)
    if not rates or result.estimate is None:
        return ""
    encounters = f"{result.config.encounters_per_hour:g} encounters an hour"
    _, per_hour, interval, hours, hours_interval = rate_rows(result)[0]
    if rates[0].hours_between is None and rates[0].high is None:
        return f"With {encounters}: nothing is known of violations an hour"
    if rates[0].hours_between is None:
        return f"With {encounters}: no violation was seen; an hour brings {interval} of them"
    if interval == UNKNOWN:
        ends = hours_ends = "interval unknown"
    else:
        named = "" if run_interval_caveats(result) else f"{level_text(result.estimate)} interval "
        ends, hours_ends = f"{named}{interval}", hours_interval
    return (
        f"With {encounters}, as the scenario draws them: {per_hour} violations an hour ({ends}), "
        f"one in {hours} hours of driving ({hours_ends})"
    )


def rate_rows(result: RunResult) -> list[tuple[str, ...]]:
    """What :data:`RATE_COLUMNS` name: of all that is violated, then of each rule."""
    rates = violation_rates(result)
    if not rates or result.estimate is None:
        return []
    every = "any rule" if result.rules else "the specification"
    rows = [(every, *_figures(rates[0], result.estimate, run_interval_caveats(result)))]
    rows += [
        (rule.name, *_figures(rate, rule.estimate, interval_caveats(rule.estimate)))
        for rate, rule in zip(rates[1:], result.rules, strict=True)
    ]
    return rows


def rates_markdown(result: RunResult, *, level: str) -> list[str]:
    """The rates as markdown under a heading of that level; none without encounters an hour."""
    rows = [tuple(map(markdown_text, row)) for row in rate_rows(result)]
    if not rows:
        return []
    table = markdown_table(RATE_COLUMNS, rows)
    return [f"{level} {RATES_TITLE}", table, rate_note(result)]


def rate_note(result: RunResult) -> str:
    """What the rates take for granted; empty without encounters an hour."""
    encounters = result.config.encounters_per_hour
    if encounters is None:
        return ""
    words = assumed_encounters(encounters)
    return f"{words[0].upper()}{words[1:]}."


def _figures(
    rate: ViolationRate, estimate: Estimate, caveats: Sequence[str]
) -> tuple[str, str, str, str]:
    wrong = f", {no_interval_text(estimate)}" if caveats else ""
    digits = digits_of(rate.low, rate.high)
    ends = _range(rate.low, rate.high, digits)
    if rate.low is None and rate.high is not None:
        ends = f"at most {_quantity(rate.high, digits)}"
    hours = _range(rate.hours_low, rate.hours_high, digits)
    if rate.hours_low is not None and rate.hours_high is None:
        hours = f"at least {_quantity(rate.hours_low, digits)}"
    between = "-" if rate.hours_between is None else _quantity(rate.hours_between, digits)
    found = "0: none was seen" if estimate.failures == 0 else _quantity(rate.per_hour, digits)
    told = (f"{one}{wrong}" if one != UNKNOWN else one for one in (ends, hours))
    of_rate, of_hours = told
    return found, of_rate, between, of_hours


UNKNOWN = "unknown"


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
