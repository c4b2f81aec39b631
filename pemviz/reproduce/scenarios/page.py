"""A study of logical scenarios: what memory and tracker are worth first, all answers last."""

import platform
from collections.abc import Mapping, Sequence

from pemviz._version import __version__
from pemviz.pem import Pem
from pemviz.reports.escape import markdown_code, markdown_table, markdown_text
from pemviz.reproduce.scenarios.answers import Answer, factor, factor_words, words
from pemviz.reproduce.scenarios.cells import ANY
from pemviz.reproduce.scenarios.settings import (
    PLAIN,
    WEIGHTED,
    Cell,
    ScenarioStudySettings,
    tracker_words,
)
from pemviz.reproduce.scenarios.table import CellAnswer, details
from pemviz.sampling.estimates.diagnostics import MEANINGS, undermining

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
