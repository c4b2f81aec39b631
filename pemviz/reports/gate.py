"""The decision of a pipeline's gate: never a silent pass."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from pemviz.config.rule_words import Bound, GateLimits
from pemviz.errors import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_GATE_TRIPPED,
    EXIT_GATE_UNDECIDED,
    UndecidedError,
)
from pemviz.reports.estimate_words import bound_text
from pemviz.reports.headline_words import range_words
from pemviz.runs.answers import answers
from pemviz.runs.result import RunResult
from pemviz.runs.uncertainty import reference_diagnostics, run_diagnostics
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Diagnostic, Estimate

GateOutcome = Literal["passed", "tripped", "undecided"]

EXIT_CODES: Mapping[GateOutcome, int] = {
    "passed": EXIT_DONE,
    "tripped": EXIT_GATE_TRIPPED,
    "undecided": EXIT_GATE_UNDECIDED,
}


@dataclass(frozen=True)
class GateDecision:
    """What the gate says: ``tripped`` if the upper bound is above the limit.

    The limit is ``None`` where only rules have limits; the command line ends with the exit code.
    """

    outcome: GateOutcome
    limit: float | None
    reason: str
    exit_code: int

    @property
    def sentence(self) -> str:
        """Outcome and reason."""
        words = {"undecided": "cannot be decided"}.get(self.outcome, self.outcome)
        return f"{words}: {self.reason}"


SEVERITY: tuple[GateOutcome, ...] = ("passed", "undecided", "tripped")
"""Of several decisions the last of these holds: one rule that is broken too often is enough."""


def decide_limits(result: RunResult, *, limits: GateLimits) -> GateDecision | None:
    """The gate's decision on a run and its rules; ``None`` without a limit."""
    decisions: list[GateDecision] = []
    if limits.overall is not None:
        decisions.append(decide_run(result, limit=limits.overall, bound=limits.bound))
    if result.status != "done" and limits.rules:
        decisions = [decide_run(result, limit=1.0)]
    else:
        each = limits.rules.items()
        decisions += [_of_rule(result, name, limit, bound=limits.bound) for name, limit in each]
    if not decisions:
        return None
    worst = max(decisions, key=lambda decision: SEVERITY.index(decision.outcome))
    decisive = [one.reason for one in decisions if one.outcome == worst.outcome]
    return replace(worst, limit=limits.overall, reason="; ".join(decisive))


def _of_rule(
    result: RunResult, name: str, limit: float, *, bound: Bound = "sampling"
) -> GateDecision:
    """What the reference says against the run it says against each of its rules."""
    for rule in result.rules:
        if rule.name == name:
            known = (*rule.estimate.diagnostics, *reference_diagnostics(result))
            decision = decide_gate(rule.estimate, limit=limit, diagnostics=known)
            decision = _beside_range(decision, result, rule=name, limit=limit, bound=bound)
            return replace(decision, reason=f"rule {name}: {decision.reason}")
    return GateDecision("undecided", limit, f"rule {name}: no estimate", EXIT_GATE_UNDECIDED)


def decide_run(result: RunResult, *, limit: float, bound: Bound = "sampling") -> GateDecision:
    """The gate's decision on a run; one that did not finish decides nothing."""
    if result.status != "done":
        message = result.message or "what was finished is in the run folder"
        words = f"the run {result.status} ({message})"
        return GateDecision("undecided", limit, words, EXIT_FAILED)
    if result.estimate is None:
        return GateDecision("undecided", limit, "there is no estimate", EXIT_GATE_UNDECIDED)
    decision = decide_gate(result.estimate, limit=limit, diagnostics=run_diagnostics(result))
    return _beside_range(decision, result, rule=None, limit=limit, bound=bound)


def _beside_range(
    decision: GateDecision, result: RunResult, *, rule: str | None, limit: float, bound: Bound
) -> GateDecision:
    """A pass, judged by the upper end to act on if that is asked for; else said beside it."""
    if decision.outcome != "passed":
        return decision
    found = next(
        one.open for one in answers(result) if (None if one.rule is None else one.rule.name) == rule
    )
    act_on = ", ".join(range_words(found, result))
    act_on = f"{act_on[0].lower()}{act_on[1:]}"
    is_below = found.high is not None and found.high <= limit
    if bound == "sampling":
        beside = "" if is_below else f"; but {act_on}"
        return replace(decision, reason=f"{decision.reason}{beside}")
    outcome: GateOutcome = "passed" if is_below else "tripped"
    if found.high is None:
        outcome = "undecided"
    else:
        act_on += f", which is {'not ' if is_below else ''}above {limit:g}"
    return GateDecision(outcome, limit, act_on, EXIT_CODES[outcome])


def raise_if_undecided(result: RunResult) -> None:
    """End a program with the reason where nothing may be decided by a run's answer.

    Raises:
        UndecidedError: The run did not finish, or one of its intervals is none, and why.
    """
    decided = decide_run(result, limit=1.0)
    reasons = [decided.reason] if decided.outcome == "undecided" else []
    for rule in result.rules:
        of_rule = _of_rule(result, rule.name, 1.0)
        reasons += [of_rule.reason] if of_rule.outcome == "undecided" else []
    if reasons:
        raise UndecidedError("; ".join(reasons))


def decide_gate(
    estimate: Estimate, *, limit: float, diagnostics: tuple[Diagnostic, ...] | None = None
) -> GateDecision:
    """Compare an estimate's upper bound with ``limit``.

    Above the limit it trips, whatever else is wrong; an interval that is none never passes. If
    ``diagnostics`` are not given, the estimate's own are all that is known to be wrong.
    """
    against = interval_caveats(estimate, diagnostics)
    outcome: GateOutcome
    if estimate.ci_high is None:
        outcome, words = "undecided", "; ".join(("there is no upper bound", *against))
    elif against and estimate.ci_high <= limit:
        outcome, words = "undecided", "; ".join(against)
    else:
        is_above = estimate.ci_high > limit
        outcome = "tripped" if is_above else "passed"
        bound = bound_text(estimate, caveats=against)
        words = f"{bound} is {'above' if is_above else 'not above'} {limit:g}"
    return GateDecision(outcome, limit, words, EXIT_CODES[outcome])
