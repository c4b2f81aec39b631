"""The answers to several rules as rows, for the terminal and every page."""

from collections.abc import Sequence

from pemviz.reports.estimate_text import interval_text, number_text, probability_text
from pemviz.runs.result import RunResult
from pemviz.sampling.estimates.trust import interval_caveats

RULES_TITLE = "Each rule by itself"
RULE_COLUMNS = ("rule", "is broken with probability", "interval", "log10")


def rule_rows(result: RunResult) -> list[tuple[str, ...]]:
    """Name, probability, interval and its logarithm of every rule; none without rules."""
    return [
        (
            rule.name,
            probability_text(rule.estimate),
            interval_text(rule.estimate, caveats=interval_caveats(rule.estimate)),
            number_text(rule.estimate.log10_probability),
        )
        for rule in result.rules
    ]


def rule_warnings(result: RunResult) -> Sequence[str]:
    """What is wrong with the answers to single rules, each with the rule's name."""
    return [f"rule {rule.name}: {text}" for rule in result.rules for text in rule.estimate.warnings]
