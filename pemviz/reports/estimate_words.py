"""Numbers and estimates in words: the same digits, and the same words, wherever they are told."""

import math
import re
from collections.abc import Mapping, Sequence

from pemviz.analysis.model_uncertainty import ModelInterval
from pemviz.binomial import exact_upper_bound
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.runs.result import PemInfo, RunResult
from pemviz.sampling.estimates.trust import rests_on_weights
from pemviz.sampling.registry import by_name
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.types import Estimate

UNKNOWN, NAMELESS = "unknown", "data that it does not name"
FEWEST_DIGITS, MOST_DIGITS = 2, 4
NEARLY, FAR = 0.8, 2.0
"""Of the minutes, from which on these are what ended a count; times the half-width asked for, from
which on a count was not carried to its end."""
NONE_SEEN = "0: no violation was seen"
REFITS = "refits of one architecture on the same data, not other model classes"
"""What the error model's ensemble is."""


def end_text(value: float, *, digits: int = FEWEST_DIGITS) -> str:
    """An end of a range with so many digits, also where the last is 0, so that both ends match."""
    return "0" if value == 0.0 else f"{value:#.{digits}g}".rstrip(".")


def digits_of(low: float | None, high: float | None) -> int:
    """How many digits tell both ends of a range apart, four at most."""
    digits = FEWEST_DIGITS
    if low is None or high is None or low == high:
        return digits
    while digits < MOST_DIGITS and end_text(low, digits=digits) == end_text(high, digits=digits):
        digits += 1
    return digits


def range_text(low: float | None, high: float | None, *, digits: int | None = None) -> str:
    """Both ends with as many digits as tell them apart; 'unknown' where either is not known."""
    if low is None or high is None:
        return UNKNOWN
    digits = digits_of(low, high) if digits is None else digits
    return f"{end_text(low, digits=digits)} to {end_text(high, digits=digits)}"


def number_text(value: float | None, *, unit: str = "", digits: int = 3, none: str = "-") -> str:
    """A number with its unit; without one a dash, or ``none``."""
    return none if value is None else f"{value:.{digits}g} {unit}".strip()


def share_text(value: float | None) -> str:
    """A share in per cent, small ones with a digit that counts, or a dash."""
    if value is None:
        return "-"
    per_cent = 100.0 * value
    return f"{per_cent:.0f} %" if per_cent >= 0.95 or value == 0.0 else f"{per_cent:.1g} %"


def next_text(remedy: str | None) -> Sequence[str]:
    """What to do where an interval is none, as a line; no line without a remedy."""
    return () if remedy is None else (f"try next: {remedy}",)


def probability_text(estimate: Estimate) -> str:
    """The probability with its standard error, or what is known without a failure."""
    if estimate.failures == 0:
        return NONE_SEEN
    error = "" if estimate.std_error is None else f" +- {estimate.std_error:.2g}"
    return f"{estimate.probability:.3g}{error}"


def short_probability(estimate: Estimate) -> str:
    """The probability with as many digits as the ends of its ranges have beside it."""
    if estimate.failures == 0:
        return NONE_SEEN
    if estimate.probability == 0.0 and estimate.log10_probability is not None:
        return f"10^{estimate.log10_probability:.1f}"
    return end_text(estimate.probability, digits=digits_of(estimate.ci_low, estimate.ci_high))


def level_text(estimate: Estimate) -> str:
    """The level of an estimate's interval: '95 %'."""
    return f"{100.0 * estimate.confidence:g} %"


def no_interval_text(estimate: Estimate) -> str:
    """What an interval is called that does not hold at its level."""
    return f"not a {level_text(estimate)} interval"


def interval_name(estimate: Estimate, *, caveats: Sequence[str]) -> str:
    """What an interval with these caveats may be called."""
    return "interval" if caveats else f"{level_text(estimate)} interval"


def interval_text(estimate: Estimate, *, caveats: Sequence[str]) -> str:
    """The confidence interval in words, and with ``caveats`` that and why it is none."""
    ends = range_text(estimate.ci_low, estimate.ci_high)
    if ends == UNKNOWN or not caveats:
        return ends
    return f"{ends}, {no_interval_text(estimate)}: {'; '.join(caveats)}"


def bound_text(estimate: Estimate, *, caveats: Sequence[str]) -> str:
    """The interval's upper end in words, and with ``caveats`` that and why it is no bound."""
    level = level_text(estimate)
    if estimate.ci_high is None:
        return f"the upper {level} bound, unknown,"
    if not caveats:
        return f"the upper {level} bound {estimate.ci_high:.3g}"
    return f"the upper bound {estimate.ci_high:.3g} (not a {level} bound: {'; '.join(caveats)})"


def reference_text(reference: Reference, estimate: Estimate) -> str:
    """The reference with its standard error, and the estimate as a multiple of it.

    Without a standard error it is a recursion over all states.
    """
    if not reference.probability:
        return f"0 +- {reference.std_error:.1g}"
    error = f"+- {reference.std_error:.1g}" if reference.std_error else "by recursion"
    exact = f"{reference.probability:.4g} {error}"
    return f"{exact}; the estimate is {estimate.probability / reference.probability:.3g} times that"


def violations_text(estimate: Estimate) -> str:
    """How many of the rollouts that count violate, and how many were simulated."""
    counted = f"{estimate.failures} of {estimate.rollouts_in_estimate} rollouts"
    if estimate.rollouts_simulated == estimate.rollouts_in_estimate:
        return counted
    return f"{counted} ({estimate.rollouts_simulated} simulated in all)"


def method_text(result: RunResult) -> str:
    """The method, and what it came to where it chose one: 'auto, which chose monte-carlo'."""
    method, estimate = result.config.method, result.estimate
    if estimate is None or estimate.method == method:
        return method
    return f"{method}, which chose {estimate.method}"


def chosen_text(result: RunResult) -> str | None:
    """Why a method that goes on chose what it did, and how far it came; ``None`` of others.

    For instance '0 of the first 240 plain rollouts violate, which alone puts it below 0.012; the
    interval is +- 9.8 %, 20 % were requested'.
    """
    config, estimate = result.config, result.estimate
    most = by_name(config.method).most
    if estimate is None or not result.stages or most is None:
        return None
    widths = {rule.name: rule.estimate.relative_half_width for rule in result.rules}
    widths = {name: width for name, width in widths.items() if math.isfinite(width)}
    whose = max(widths, key=lambda name: widths[name], default="")
    first, half = result.stages[0], widths.get(whose, estimate.relative_half_width)
    widest = f"the widest interval, of {whose}," if len(widths) > 1 else "the interval"
    reached = f"{widest} is +- {100.0 * half:.{1 if half < 0.1 else 0}f} %"
    bound = exact_upper_bound(first.failures, first.rollouts)
    alone = "" if first.failures else f", which alone puts it below {bound:.2g}"
    words = (
        f"{first.failures} of the first {first.rollouts} plain rollouts violate{alone}; "
        f"{reached if math.isfinite(half) else 'no interval'}, {100.0 * config.precision:.3g} % "
        "were requested"
    )
    if half <= config.precision:
        return words
    if config.max_rollouts is None:
        spent = max(_from_proposals(result).values(), default=0)
        if spent >= most(config):
            return f"{words}, and stopped by max_rollouts: {spent} were sampled from proposals"
    elif estimate.rollouts_simulated > config.max_rollouts - config.repetitions:
        return f"{words}, and stopped by max_rollouts {config.max_rollouts}"
    counts = by_name(estimate.method).interval_basis == "counts"
    if config.max_minutes is not None:
        # a count that came to an end met violations by which its number was chosen
        took_s = result.timings_s.get("total", math.inf)
        is_cut = not estimate.failures or took_s >= NEARLY * 60.0 * config.max_minutes
        # of a run that went on, that took its time before, the width tells
        if not counts or is_cut or half > FAR * config.precision:
            return f"{words}, and stopped by max_minutes {config.max_minutes:g}"
    if counts:
        words += f"; {estimate.rollouts_in_estimate} plain rollouts were counted, as many as the "
        words += "first ones asked for"
    return words


def surrogate_text(result: RunResult) -> str | None:
    """What was learned on a surrogate first; ``None`` if nothing was.

    For instance 'proposals were learned first on 4400 rollouts of surrogate vectorized, whose own
    failure probability is 8.8e-15'.
    """
    found = result.surrogate
    if found is None:
        return None
    where = f"{found.rollouts} rollouts of surrogate {found.name}"
    if found.probability == 0.0:
        return f"{where} taught nothing: none of them violates"
    its_own = f"whose own failure probability is {number_text(found.probability)}"
    return f"proposals were learned first on {where}, {its_own}"


def _from_proposals(result: RunResult) -> Mapping[int, int]:
    """Rollouts that each repetition that learned has sampled from proposals."""
    spent = dict.fromkeys((one.repetition for one in result.stages if one.kind == "learn"), 0)
    for stage in result.stages:
        if stage.repetition in spent:  # the last stage before those that learn begins them
            before = 0 if stage.kind == "pretrain" else spent[stage.repetition]
            spent[stage.repetition] = before + stage.rollouts
    return spent


def missing_more_text(estimate: Estimate) -> str:
    """Why so many rollouts violate, where they were sampled from another distribution."""
    return ", sampled to miss more often," if rests_on_weights(estimate.method) else ""


def model_range_text(interval: ModelInterval | None) -> str:
    """The answer's range over refits of the error model."""
    if interval is None:
        return "unknown: the model has no ensemble, or nothing failed"
    high = UNKNOWN if interval.high is None else end_text(interval.high)
    ends = f"{end_text(interval.low or 0.0)} to {high}"
    return f"{ends} ({interval.confidence:.0%} of {interval.members} {REFITS})"


def beyond_default_text(result: RunResult) -> str:
    """What of tracker and measured distances the run goes beyond; empty where nothing."""
    config, parts = result.config, list[str]()
    if config.scenario.tracker != NO_TRACKER:
        parts.append(f"tracker {config.scenario.tracker}")
    if result.position_errors is not None:
        parts.append(f"position errors {result.position_errors.name}")
    return ", ".join(parts)


def model_text(pem: PemInfo) -> str:
    """An error model, and what it learned from, if it says so."""
    if not pem.data or pem.data.startswith(NAMELESS):
        return f"{pem.name} is a model of the user's own, and names no data"
    return f"{pem.name} learned from {data_text(pem)}"


def data_text(pem: PemInfo) -> str:
    """What an error model learned from, as far as a line needs it: up to the first detail."""
    return re.split(r" \(|; ", pem.data, maxsplit=1)[0] or NAMELESS
