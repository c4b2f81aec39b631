"""What stands beside an answer: each rule's, the rates, the uncertainty budget."""

from collections.abc import Sequence
from dataclasses import dataclass

from pemviz.reports.document import Table
from pemviz.reports.estimate_words import (
    UNKNOWN,
    digits_of,
    end_text,
    level_text,
    no_interval_text,
)
from pemviz.runs.answers import answers
from pemviz.runs.rates import Rate, assumed_distance, assumed_encounters, rates
from pemviz.runs.result import RunResult
from pemviz.runs.uncertainty import (
    UncertaintySource,
    run_diagnostics,
    run_interval_caveats,
    uncertainty_budget,
)
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

UNCERTAINTY_TITLE = "How far the answer is open"
NOT_ADDED_UP = (
    "Each bar is one source of doubt; they are not added up, as each takes for granted what the "
    "others doubt."
)
TAKEN_AS_INDEPENDENT = "each but the memory of misses takes misses as independent of each other"
LARGEST_PLAIN = 1e6
"""From here on rates are written with an exponent."""


def rule_warnings(result: RunResult) -> Sequence[str]:
    """What is wrong with the answers to single rules and not with the whole answer, with names."""
    of_answer = {diagnostic.text for diagnostic in run_diagnostics(result)}
    of_answer |= set(() if result.pem_interval is None else result.pem_interval.warnings)
    names: dict[str, list[str]] = {}
    for answer in answers(result):
        if answer.rule is None or answer.impossible:
            continue
        refits = answer.rule.refits
        for text in (*answer.estimate.warnings, *(() if refits is None else refits.warnings)):
            if text not in of_answer:
                names.setdefault(text, []).append(answer.rule.name)
    return [
        f"rule{'s' if len(rules) > 1 else ''} {', '.join(rules)}: {text}"
        for text, rules in names.items()
    ]


@dataclass(frozen=True)
class _Unit:
    """Of driving: over a table, with its article, its plural, the plural in a sentence."""

    title: str
    each: str
    between: str
    driving: str


_HOUR = _Unit("Per hour of driving", "an hour", "hours", "hours of driving")
_KILOMETRE = _Unit("Per kilometre of driving", "a kilometre", "kilometres", "kilometres of driving")


def rates_table(result: RunResult) -> Table | None:
    """Violations an hour or a kilometre and what lies between them, in all and of each rule."""
    found, unit = rates(result), _HOUR if result.driven is None else _KILOMETRE
    if not found or result.estimate is None:
        return None
    every = "any rule" if result.rules else "the specification"
    rows = [(every, *_rate_row(found[0], result.estimate, run_interval_caveats(result)))]
    rows += [
        (rule.name, *_rate_row(rate, rule.estimate, interval_caveats(rule.estimate)))
        for rate, rule in zip(found[1:], result.rules, strict=True)
    ]
    between = f"{unit.between} between two"
    columns = ("violation of", unit.each, "interval", between, "their interval")
    return Table(columns, tuple(rows), name=unit.title)


def rate_line(result: RunResult) -> str:
    """The rate in all with its interval in a sentence; empty where there is none."""
    found, unit = rates(result), _HOUR if result.driven is None else _KILOMETRE
    if not found or result.estimate is None:
        return ""
    if result.driven is None:
        given = f"With {result.config.encounters_per_hour:g} encounters an hour"
        sampled = ", as the scenario samples them"
    else:
        given, sampled = f"With {result.driven.mean_km:.3g} km a rollout", ""
    caveats = run_interval_caveats(result)
    value, interval, between, between_interval = _rate_row(found[0], result.estimate, caveats)
    if found[0].between is None and found[0].high is None:
        return f"{given}: nothing is known of violations {unit.each}"
    if found[0].between is None:
        return f"{given}: no violation was seen; {unit.each} brings {interval} of them"
    if interval == UNKNOWN:
        interval = between_interval = "interval unknown"
    elif not caveats:
        interval = f"{level_text(result.estimate)} interval {interval}"
    return (
        f"{given}{sampled}: {value} violations {unit.each} ({interval}), "
        f"one in {between} {unit.driving} ({between_interval})"
    )


def rate_note(result: RunResult) -> str:
    """What the rates take for granted; empty where there are none."""
    encounters = result.config.encounters_per_hour
    if result.driven is not None:
        words = assumed_distance(result.driven)
    elif encounters is not None:
        words = assumed_encounters(encounters)
    else:
        return ""
    return f"{words[0].upper()}{words[1:]}."


def _rate_row(rate: Rate, estimate: Estimate, caveats: Sequence[str]) -> tuple[str, str, str, str]:
    """The rate, its interval, what lies between two, and the interval of that."""
    digits = digits_of(rate.low, rate.high)

    def quantity(value: float) -> str:
        """With so many digits that count, as a plain number where that is readable."""
        rounded = float(f"{value:.{digits}g}")
        if 10.0 ** (digits - 1) <= rounded < LARGEST_PLAIN:
            return f"{rounded:,.0f}"
        return end_text(value, digits=digits)

    def ends(low: float | None, high: float | None) -> str:
        if low is not None and high is not None:
            words = f"{quantity(low)} to {quantity(high)}"
        elif high is not None:
            words = f"at most {quantity(high)}"
        elif low is not None:
            words = f"at least {quantity(low)}"
        else:
            return UNKNOWN
        return f"{words}, {no_interval_text(estimate)}" if caveats else words

    return (
        "0: none was seen" if estimate.failures == 0 else quantity(rate.value),
        ends(rate.low, rate.high),
        "-" if rate.between is None else quantity(rate.between),
        ends(rate.between_low, rate.between_high),
    )


def uncertainty_title(result: RunResult) -> str:
    """Of several rules it is about whether any is broken; each has its own range in their table."""
    rules = len(result.config.rules)
    return f"{UNCERTAINTY_TITLE}: any of {rules} rules" if rules > 1 else UNCERTAINTY_TITLE


def uncertainty_table(result: RunResult) -> Table | None:
    """Name, both ends and what would narrow it, of each source; ``None`` without any."""
    rows: list[tuple[str, ...]] = []
    for source in uncertainty_budget(result):
        digits = digits_of(source.low, source.high)
        low, high = (
            UNKNOWN if end is None else end_text(end, digits=digits)
            for end in (source.low, source.high)
        )
        rows.append((source_name(source), low, high, source.narrowed_by))
    if not rows:
        return None
    independent = result.memory is not None and result.memory.is_independent
    columns, note = ("by", "from", "to", "narrowed by"), TAKEN_AS_INDEPENDENT if independent else ""
    return Table(columns, tuple(rows), numbers=(1, 2), note=note)


def source_name(source: UncertaintySource) -> str:
    """Its name, and what is to be said of its ends; an interval's caveats stand elsewhere."""
    noted = source.note and source.kind != "sampling"
    return f"{source.name}; {source.note}" if noted else source.name
