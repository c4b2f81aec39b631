"""An estimate and its diagnostics in words, the same on the terminal and in reports."""

import re
from collections.abc import Sequence

from pemviz.analysis.model_uncertainty import ModelInterval
from pemviz.config import ExperimentConfig
from pemviz.config.encounters import NO_FAMILY
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.pem.models.memory import FRAILTY_MEANS
from pemviz.reports.digits import digits_of, end_text
from pemviz.runs.memory import RunMemory
from pemviz.runs.result import PemInfo, RunResult
from pemviz.sampling.estimates.meanings import RELIABLE_PARETO_K
from pemviz.sampling.estimates.trust import rests_on_weights
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.types import Estimate

RELIABLE_TAIL = f"(reliable up to {RELIABLE_PARETO_K:g})"
"""What stands beside Pareto k-hat."""
IN_IT = "(in which the correlation of outcomes falls to 37 %)"
"""What a memory time is, in brackets beside one."""
REFITS = "refits of one architecture on the same data, not other model families"
"""What the error model's ensemble is."""


def probability_text(estimate: Estimate) -> str:
    """The probability with its standard error, or what is known without a failure."""
    if estimate.failures == 0:
        return "0: no failure was seen"
    error = "" if estimate.std_error is None else f" +- {estimate.std_error:.2g}"
    return f"{estimate.probability:.3g}{error}"


def occasion_text(config: ExperimentConfig) -> str:
    """What a probability is per: a run of the scenario, or an encounter of a family."""
    return "run" if config.encounter.family == NO_FAMILY else "encounter"


def short_probability(estimate: Estimate) -> str:
    """The probability with as many digits as the ends of its ranges have beside it."""
    if estimate.failures == 0:
        return "0: no failure was seen"
    digits = digits_of(estimate.ci_low, estimate.ci_high)
    return end_text(estimate.probability, digits=digits)


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
    if estimate.ci_low is None or estimate.ci_high is None:
        return "unknown"
    digits = digits_of(estimate.ci_low, estimate.ci_high)
    low, high = (end_text(end, digits=digits) for end in (estimate.ci_low, estimate.ci_high))
    ends = f"{low} to {high}"
    return f"{ends}, {no_interval_text(estimate)}: {'; '.join(caveats)}" if caveats else ends


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


def aimed_text(estimate: Estimate) -> str:
    """Why so many rollouts violate, where they were drawn from another distribution."""
    return ", drawn to miss more often," if rests_on_weights(estimate.method) else ""


def model_range_text(interval: ModelInterval | None) -> str:
    """The answer's range over refits of the error model."""
    if interval is None:
        return "unknown: the model has no ensemble, or nothing failed"
    low = "0" if interval.low is None else end_text(interval.low)
    high = "unknown" if interval.high is None else end_text(interval.high)
    return f"{low} to {high} ({interval.confidence:.0%} of {interval.members} {REFITS})"


def memory_text(memory: RunMemory | None) -> str:
    """How misses hang together in the answer, and in the video that the model was fitted to."""
    if memory is None or memory.is_independent:
        assumed = "independent of each other given the state: an assumption"
        if memory is None or not memory.curve:
            assumed += ", and --memory-curve tells what it is worth"
    else:
        assumed = f"in bursts, {' and '.join(_hanging_together(memory))}"
    own = None if memory is None else memory.fitted
    if own is None:
        return assumed
    measured = f"{own.tau_s:.2g} s ({own.low_s:.2g} to {own.high_s:.2g})"
    if memory is None or memory.tau_s == 0.0:
        measured += f" {IN_IT}"
    if own.frailty is not None:
        measured += f", its frailty {own.frailty:.2g}"
        if own.frailty_low is not None and own.frailty_high is not None:
            measured += f" ({own.frailty_low:.2g} to {own.frailty_high:.2g})"
    return f"{assumed}; this model's own memory time, measured on video, is {measured}"


def _hanging_together(memory: RunMemory) -> list[str]:
    parts = [f"memory time {memory.tau_s:g} s {IN_IT}"] if memory.tau_s else []
    if memory.frailty:
        parts.append(f"frailty {memory.frailty:g} ({FRAILTY_MEANS})")
    return parts


def beyond_default_text(result: RunResult) -> str:
    """What of misses, tracker and measured distances the run was asked for; empty where nothing."""
    config = result.config
    parts = [f"memory time {config.memory_s:g} s"] if config.memory_s else []
    parts += [f"frailty {config.frailty:g}"] if config.frailty else []
    if config.scenario.tracker != NO_TRACKER:
        parts.append(f"tracker {config.scenario.tracker}")
    if result.position_errors is not None:
        parts.append(f"position errors {result.position_errors.name}")
    return ", ".join(parts)


def position_errors_text(model: PemInfo) -> str:
    """By which errors distances were measured, as far as a line needs it."""
    return f"with errors of {model.name}, from {data_text(model)}"


def data_text(pem: PemInfo) -> str:
    """What an error model learnt from, as far as a line needs it: up to the first detail."""
    return re.split(r" \(|; ", pem.data, maxsplit=1)[0] or "data that it does not name"


def number_text(value: float | None, *, unit: str = "") -> str:
    """A number with its unit, or a dash."""
    return "-" if value is None else f"{value:.3g} {unit}".strip()


def share_text(value: float | None) -> str:
    """A share in per cent, small ones with a digit that counts, or a dash."""
    if value is None:
        return "-"
    return f"{value:.0%}" if value >= 0.1 or value == 0.0 else f"{100.0 * value:.1g}%"
