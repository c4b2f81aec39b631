"""The answers to several rules, from the rollouts of one run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pemviz.config import Rule
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.method import AnswersRules, Method
from pemviz.types import Estimate


@dataclass(frozen=True)
class RuleAnswer:
    """How likely one of several rules is broken.

    Attributes:
        name: The rule's.
        formula: The rule.
        estimate: The probability that it is broken, whatever becomes of the others.
    """

    name: str
    formula: str
    estimate: Estimate


def estimates_by_rule(
    method: Method[Any], state: Any, rules: Sequence[Rule]
) -> Mapping[str, Estimate]:
    """Each rule's estimate by a repetition that is done.

    Raises:
        TypeError: The method answers none.
    """
    if not rules:
        return {}
    if not isinstance(method, AnswersRules):
        message = f"method {method.name} answers no rules"
        raise TypeError(message)
    return {rule.name: method.estimate(method.under_rule(state, rule.name)) for rule in rules}


def rule_answers(
    rules: Sequence[Rule], repetitions: Sequence[Mapping[str, Estimate]]
) -> tuple[RuleAnswer, ...]:
    """The answers of all repetitions together."""
    return tuple(
        RuleAnswer(
            name=rule.name,
            formula=rule.formula,
            estimate=summarise_repetitions([found[rule.name] for found in repetitions]),
        )
        for rule in rules
    )
