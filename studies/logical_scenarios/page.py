"""A study of logical scenarios: what memory and tracker change first, all answers last."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pemviz._version import __version__
from pemviz.pem import Pem
from pemviz.reports.escape import markdown_code, markdown_table, markdown_text
from pemviz.reproduce.tables import Column, Table
from pemviz.sampling.estimates.diagnostics import MEANINGS, undermining
from pemviz.types import Estimate
from studies.logical_scenarios.answers import (
    Answer,
    Basis,
    answer,
    factor,
    factor_words,
    range_words,
    reasons,
    why_not,
    words,
)
from studies.logical_scenarios.settings import (
    ANY,
    PLAIN,
    WEIGHTED,
    Cell,
    ScenarioStudySettings,
    tracker_words,
)

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


SHOWN = ("no-collision", ANY)
"""Rules that tables and picture show; all are in the details and in the file."""
TITLES = {"no-collision": "collision", ANY: "any rule broken"}
MARKS = {"counted": "", "weighted": " m", "few": " f", "bound": ""}
SITUATIONS = {
    "braking": "a lead car brakes",
    "cut-in": "a car cuts in ahead of the ego",
    "cut-out": "a lead car leaves the lane and reveals a slower one",
}
ByCell = Mapping[tuple[Cell, str], Answer]


def page_markdown(
    settings: ScenarioStudySettings,
    answers: Sequence[CellAnswer],
    *,
    pem: Pem,
    cpu_s: Mapping[str, float],
) -> str:
    """How to read it, a section for each logical scenario, all answers, provenance.

    Args:
        settings: What was asked.
        answers: Every rule in every cell.
        pem: The error model.
        cpu_s: By method, what its cells took [s].
    """
    by_cell = {(one.cell, one.rule): one.answer for one in answers}
    parts = [
        "# Encounters: what a detector's memory and a tracker are worth",
        _introduction(settings),
        "![Probability against memory, by tracker](scenarios.png)",
    ]
    parts += [
        _section(settings, logical_scenario, by_cell)
        for logical_scenario in settings.logical_scenarios
    ]
    parts += ["## All answers", _how_answers_are_chosen(answers)]
    for logical_scenario in settings.logical_scenarios:
        parts += [f"### {logical_scenario}", details(logical_scenario, answers)]
    parts += ["## Provenance", _provenance(settings, pem, cpu_s)]
    return "\n\n".join(parts) + "\n"


def _introduction(settings: ScenarioStudySettings) -> str:
    return (
        "Probabilities are per encounter, with random starts as "
        "`pemviz.simulators.encounters` draws them. *Memory* is how long a detector's misses hang "
        "together: after a miss the next is likelier, by exp(-time / memory), while it misses as "
        "often in all. A *tracker* M of N tells the ego of a car once M of the last N outcomes "
        "detected it; without one the ego is told of single detections.\n\n"
        "Every probability here comes with a 95 % interval that may be trusted. Without a mark: "
        f"counted, at least ten times in {settings.plain_rollouts:,} plain rollouts. **m**: by "
        f"mixture, {settings.rollouts:,} rollouts, with nothing in its diagnostics against it. "
        "**f**: counted fewer than ten times, the order of magnitude. *Below*: not seen, the "
        "upper end of the plain interval. Mixture's other answers are under *All answers* alone."
    )


def _section(settings: ScenarioStudySettings, logical_scenario: str, by_cell: ByCell) -> str:
    parts = [f"## {logical_scenario}: {SITUATIONS[logical_scenario]}"]
    for rule in SHOWN:
        header = (f"P({TITLES[rule]})", *(f"memory {one:g} s" for one in settings.memories_s))
        rows = [
            (
                markdown_text(tracker_words(tracker)),
                *_answers_of(settings, logical_scenario, tracker, rule, by_cell),
            )
            for tracker in settings.trackers
        ]
        parts.append(markdown_table(header, rows))
    changes = _changes(settings, logical_scenario)
    if changes:
        header = ("what it is worth: times as likely", *(TITLES[rule] for rule in SHOWN))
        rows = [
            (
                markdown_text(label),
                *(
                    factor_words(factor(by_cell[after, rule], by_cell[before, rule]))
                    for rule in SHOWN
                ),
            )
            for label, before, after in changes
        ]
        parts.append(markdown_table(header, rows))
    return "\n\n".join(parts)


def _answers_of(
    settings: ScenarioStudySettings, logical_scenario: str, tracker: str, rule: str, by_cell: ByCell
) -> list[str]:
    found = [by_cell[Cell(logical_scenario, one, tracker), rule] for one in settings.memories_s]
    return [f"{words(one)}{MARKS[one.basis]}" for one in found]


def _changes(
    settings: ScenarioStudySettings, logical_scenario: str
) -> list[tuple[str, Cell, Cell]]:
    """What is compared: the longest memory with the first, then each tracker with the first."""
    memories_s, trackers = settings.memories_s, settings.trackers
    least, most = min(memories_s), max(memories_s)
    found: list[tuple[str, Cell, Cell]] = []
    if least < most:
        found += [
            (
                f"memory {most:g} s instead of {least:g} s, {tracker_words(tracker)}",
                Cell(logical_scenario, least, tracker),
                Cell(logical_scenario, most, tracker),
            )
            for tracker in trackers
        ]
    found += [
        (
            f"{tracker_words(tracker)} instead of {tracker_words(trackers[0])}, memory {one:g} s",
            Cell(logical_scenario, one, trackers[0]),
            Cell(logical_scenario, one, tracker),
        )
        for tracker in trackers[1:]
        for one in memories_s
    ]
    return found


def _how_answers_are_chosen(answers: Sequence[CellAnswer]) -> str:
    kinds = {
        one.kind
        for each in answers
        if each.is_seen
        for one in undermining(each.weighted.diagnostics, basis="weights")
    }
    count = {basis: sum(one.answer.basis == basis for one in answers) for basis in MARKS}
    text = (
        f"Of {len(answers)} answers {count['counted']} are counted at least ten times, "
        f"{count['weighted']} mixture's, {count['few']} counted fewer than ten times, "
        f"{count['bound']} bounds. Mixture's answer counts where plain Monte Carlo has seen fewer "
        "than ten events, nothing in its diagnostics speaks against its interval, and that meets "
        "the plain one. *Mixture / plain* is told wherever both have seen the event, also where "
        "mixture warns."
    )
    meanings = [
        f"- {markdown_code(kind)}: {markdown_text(meaning.in_repetitions or '')}"
        for kind, meaning in MEANINGS.items()
        if kind in kinds
    ]
    return "\n\n".join([text, *(["\n".join(meanings)] if meanings else [])])


def _provenance(settings: ScenarioStudySettings, pem: Pem, cpu_s: Mapping[str, float]) -> str:
    rows = [
        ("experiments", "presets of the logical scenarios, vectorized back end"),
        ("seed", str(settings.seed)),
        ("perception error model", markdown_code(pem.name)),
        ("its digest (SHA-256)", markdown_code(pem.digest)),
        ("versions", f"pemviz {__version__}, Python {platform.python_version()}"),
        (
            "CPU time",
            f"mixture {cpu_s[WEIGHTED]:.0f} s, plain Monte Carlo {cpu_s[PLAIN]:.0f} s",
        ),
    ]
    return markdown_table(("what", "value"), rows)
