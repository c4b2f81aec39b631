"""The answers to several rules, and what is wrong with each."""

from collections.abc import Sequence

from pemviz.reports.estimate_words import interval_text, no_interval_text, probability_text
from pemviz.reports.numbers import number_text
from pemviz.runs.result import RunResult
from pemviz.runs.trust import run_diagnostics, run_interval_caveats
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

RULES_TITLE = "Each rule by itself"
RULE_COLUMNS = ("rule", "is broken with probability", "interval", "log10")


def rule_rows(result: RunResult) -> list[tuple[str, ...]]:
    """Name, probability, interval and its logarithm of every rule; none without rules."""
    against = run_interval_caveats(result)
    return [
        (
            rule.name,
            probability_text(rule.estimate),
            _interval(rule.estimate, against),
            number_text(rule.estimate.log10_probability),
        )
        for rule in result.rules
    ]


def _interval(estimate: Estimate, against_answer: Sequence[str]) -> str:
    """A rule's interval; what speaks against that of the whole answer too is not told again."""
    caveats = interval_caveats(estimate)
    own = [text for text in caveats if text not in against_answer]
    words = interval_text(estimate, caveats=own)
    if own or not caveats or estimate.ci_low is None:
        return words
    return f"{words}, {no_interval_text(estimate)} either"


def rule_warnings(result: RunResult) -> Sequence[str]:
    """What is wrong with the answers to single rules and not with the whole answer, with names."""
    told = {diagnostic.text for diagnostic in run_diagnostics(result)}
    names: dict[str, list[str]] = {}
    for rule in result.rules:
        for text in rule.estimate.warnings:
            if text not in told:
                names.setdefault(text, []).append(rule.name)
    return [
        f"rule{'s' if len(rules) > 1 else ''} {', '.join(rules)}: {text}"
        for text, rules in names.items()
    ]
