"""All answers of a study of logical scenarios: every cell, every rule, both methods."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pemviz.reports.escape import markdown_table, markdown_text
from pemviz.reproduce.scenarios.answers import (
    Answer,
    Basis,
    answer,
    range_words,
    reasons,
    why_not,
    words,
)
from pemviz.reproduce.scenarios.settings import Cell
from pemviz.reproduce.tables import Column, Table
from pemviz.types import Estimate

ByRule = Mapping[str, Estimate]

COLUMNS = tuple(
    Column(key, "")
    for key in (
        "logical_scenario",
        "rule",
        "tracker",
        "memory_s",
        "basis",
        "probability",
        "low",
        "high",
        "plain_violations",
        "plain_rollouts",
        "plain_low",
        "plain_high",
        "mixture_probability",
        "mixture_low",
        "mixture_high",
        "mixture_over_plain",
        "mixture_ess",
        "mixture_pareto_k",
        "against_mixture",
    )
)
HEADER = (
    "rule",
    "tracker",
    "memory",
    "answer",
    "which is",
    "plain: seen",
    "mixture",
    "mixture / plain",
    "ESS",
    "k-hat",
    "speaks against mixture's interval",
)
BASES: Mapping[Basis, str] = {
    "counted": "counted",
    "weighted": "mixture's",
    "few": "counted, few",
    "bound": "a bound",
}


@dataclass(frozen=True)
class CellAnswer:
    """What is known of one rule in one cell.

    Attributes:
        cell: The cell.
        rule: The rule.
        answer: What counts.
        weighted: By ``mixture``.
        plain: By ``monte-carlo``.
    """

    cell: Cell
    rule: str
    answer: Answer
    weighted: Estimate
    plain: Estimate

    @property
    def is_seen(self) -> bool:
        """Whether either method has seen the rule broken."""
        return self.weighted.failures > 0 or self.plain.failures > 0

    @property
    def ratio(self) -> float | None:
        """Mixture's answer over the plain one; ``None`` unless both have seen the rule broken."""
        if not self.weighted.failures or not self.plain.failures:
            return None
        return self.weighted.probability / self.plain.probability


def all_answers(found: Mapping[Cell, tuple[ByRule, ByRule]]) -> tuple[CellAnswer, ...]:
    """Every rule in every cell.

    Args:
        found: By cell, estimates by rule: of ``mixture``, then of ``monte-carlo``.
    """
    return tuple(
        CellAnswer(cell, rule, answer(weighted=weighted[rule], plain=one), weighted[rule], one)
        for cell, (weighted, plain) in found.items()
        for rule, one in plain.items()
    )


def csv_of(answers: Sequence[CellAnswer]) -> str:
    """All answers with every digit."""
    return Table("scenarios", "scenarios", COLUMNS, tuple(map(_row, answers))).csv()


def details(logical_scenario: str, answers: Sequence[CellAnswer]) -> str:
    """One logical scenario's answers as far as anything was seen, as markdown."""
    own = [one for one in answers if one.cell.logical_scenario == logical_scenario]
    order = list(dict.fromkeys(one.rule for one in own))
    seen = sorted((one for one in own if one.is_seen), key=lambda one: order.index(one.rule))
    text = markdown_table(HEADER, [_words(one) for one in seen])
    never = [rule for rule in order if not any(one.rule == rule for one in seen)]
    if never:
        text += f"\n\nIn none of the cells was this rule seen broken: {', '.join(never)}."
    return text


def _words(one: CellAnswer) -> tuple[str, ...]:
    weighted, plain = one.weighted, one.plain
    seen = weighted.failures > 0
    return (
        one.rule,
        markdown_text(one.cell.tracker),
        f"{one.cell.memory_s:g} s",
        words(one.answer),
        BASES[one.answer.basis],
        f"{plain.failures:,} of {plain.rollouts_in_estimate:,}",
        range_words(weighted.probability, weighted.ci_low, weighted.ci_high) if seen else "none",
        "-" if one.ratio is None else f"{one.ratio:.2f}",
        "-" if weighted.ess is None else f"{weighted.ess:.0f}",
        "-" if weighted.pareto_k is None else f"{weighted.pareto_k:.2f}",
        reasons(why_not(weighted, plain)),
    )


def _row(one: CellAnswer) -> tuple[str | float | int | None, ...]:
    weighted, plain = one.weighted, one.plain
    seen = weighted.failures > 0
    return (
        one.cell.logical_scenario,
        one.rule,
        one.cell.tracker,
        one.cell.memory_s,
        one.answer.basis,
        one.answer.probability,
        one.answer.low,
        one.answer.high,
        plain.failures,
        plain.rollouts_in_estimate,
        plain.ci_low,
        plain.ci_high,
        weighted.probability if seen else None,
        weighted.ci_low,
        weighted.ci_high,
        one.ratio,
        weighted.ess,
        weighted.pareto_k,
        reasons(why_not(weighted, plain)),
    )
