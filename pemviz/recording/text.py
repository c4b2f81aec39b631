"""The texts of a recording, as markdown."""

import json
from collections.abc import Mapping, Sequence
from itertools import groupby

from pemviz.analysis.causes import CARRIED
from pemviz.charts.chart import with_unit
from pemviz.config.toml_files import config_text
from pemviz.recording.learning import StageFigures
from pemviz.recording.rollouts import quota_text
from pemviz.recording.worst import Track
from pemviz.reports.document import Headline
from pemviz.reports.escape import markdown_table, markdown_text
from pemviz.reports.estimate_words import (
    end_text,
    interval_name,
    interval_text,
    number_text,
    share_text,
)
from pemviz.reports.headline_words import headline_blocks, range_words
from pemviz.reports.markdown import PLAIN_MARKS, blocks_markdown, sections_markdown
from pemviz.reports.run_document import ANSWER, TRUST, WHY, run_document
from pemviz.runs.answers import Answer, answers
from pemviz.runs.result import RankedRollout, RunResult
from pemviz.runs.result_file import result_document
from pemviz.runs.uncertainty import run_diagnostics
from pemviz.simulators.slots import Slot

NOTHING = "none"
KINDS = {"pretrain": " (first)", "learn": "", "final": " (final)"}
RANKED_BY_RULE = 3
NEXT_LINE = "\\\n"
"""Without a gap, for which a strip has no room."""
READ_ON = (
    "## How to read on\n"
    "- **Scene**, where the scenario says where its cars are: the least robust rollouts, every "
    "rank from above in a tab of its own; press play to watch them.\n"
    "- **Worst case**: what was random in them, and how they rank.\n"
    "- **Learning**: how the proposal came about, stage by stage.\n"
    "- **Rollouts**: what was simulated; orange curves violate the specification, blue "
    "ones do not, thick ones are the least robust.\n"
    "- **Config**: everything needed to run this again.\n\n"
    "The time panel below moves along a rollout (timelines `step` and `sim_time`). "
    "Choose `stage` there to replay the tab Learning."
)
SCENE_TEXT = (
    "On the roads the ego's centre stays at 0 m. A line around a car, in 3D a mark over it, "
    "shows what perception reports of it at the step: blue detected, orange missed (with a cross "
    "from above; larger in 3D), none or grey where there is nothing to report. Outlines, white "
    "from above and grey in 3D, and ellipses of two standard deviations: where the controller "
    "tracks a car. Green: how near a car must be for a detection to brake hard, where the scenario "
    "says so. Grey cars: contact."
)


def strip_text(result: RunResult, *, running: bool) -> str:
    """The answer in a few lines: how likely, the range to act on and what decides it, sampling."""
    found = answers(result)
    if not found:
        (section,) = run_document(result, running=running).choose(("answer",))
        said = blocks_markdown(section.full[1:], level=1, marks=PLAIN_MARKS)
        return "\n\n".join([f"**{markdown_text(section.title)}**", *said])
    first = found[0]
    (headline,) = [one for one in headline_blocks(result) if isinstance(one, Headline)]
    likely = f"**{markdown_text(headline.text)}**, {markdown_text(headline.given)}"
    if running:
        return f"{likely}{NEXT_LINE}The run goes on; stages done so far: {len(result.stages)}."
    act_on = ", ".join(range_words(first.open, result))
    return (
        f"{likely}{NEXT_LINE}**{markdown_text(act_on)}**. {markdown_text(_sampling(result, first))}"
    )


def _sampling(result: RunResult, answer: Answer) -> str:
    """Whether the sampling is to be relied on, with its interval."""
    estimate, caveats = answer.estimate, answer.caveats
    interval = interval_name(estimate, caveats=caveats)
    figures = f"{interval} {interval_text(estimate, caveats=caveats)}"
    about = run_diagnostics(result) if answer.rule is None else estimate.diagnostics
    if caveats:
        return f"Sampling not ok: {figures}"
    if about:
        return f"Sampling with a warning ({about[0].text}): {figures}"
    return f"Sampling ok: {figures}"


def answer_text(result: RunResult, *, running: bool) -> str:
    """The answer, how far it is open and what causes violations, and how to go on reading."""
    document = run_document(result, running=running)
    first, *others = document.choose(("answer", *ANSWER[2:], *WHY, *TRUST[:2], "question"))
    parts = sections_markdown([first], level=1, marks=PLAIN_MARKS)
    parts += sections_markdown(others, level=2, marks=PLAIN_MARKS)
    return "\n\n".join([*parts, READ_ON])


def warnings_text(result: RunResult) -> str:
    """What is wrong with the answer and with the error model, or that nothing is."""
    return _page(result, "warnings", "extrapolation")


def provenance_text(result: RunResult) -> str:
    """Where the numbers come from and what they assume."""
    return _page(result, "provenance", "assumptions")


def _page(result: RunResult, *keys: str) -> str:
    sections = run_document(result).choose(keys)
    return "\n\n".join(sections_markdown(sections, level=1, marks=PLAIN_MARKS))


def stage_table(rows: Sequence[StageFigures], *, robustness_unit: str) -> str:
    """Every stage's figures."""
    header = (
        "stage",
        with_unit("threshold", robustness_unit),
        "learned from",
        "violations",
        "ESS",
        "loss [nats a step]",
        "estimate",
        "95 % interval",
    )
    note = (
        "Each stage's own estimate. Threshold: rollouts at or below it are learned from; so many "
        "are. ESS: how many equally weighted violations it amounts to. An interval in "
        "brackets is not a 95 % interval; why stands below.\n\n"
    )
    doubts = [f"- stage {row.stage}: {'; '.join(row.caveats)}" for row in rows if row.caveats]
    why = "\n\n## Why some are not 95 % intervals\n" + "\n".join(doubts) if doubts else ""
    return f"# Stages\n\n{note}" + markdown_table(header, [_stage_row(row) for row in rows]) + why


def _stage_row(row: StageFigures) -> tuple[str, ...]:
    interval = "-"
    if row.log10_ci_low is not None and row.log10_ci_high is not None:
        interval = f"{_power_text(row.log10_ci_low)} to {_power_text(row.log10_ci_high)}"
        interval = f"({interval})" if row.caveats else interval
    return (
        f"{row.stage}{KINDS[row.kind]}",
        number_text(row.threshold, none=NOTHING),
        f"{row.elites}" if row.elites else NOTHING,
        f"{row.failures} of {row.rollouts}",
        number_text(row.ess, none=NOTHING),
        number_text(row.loss, none=NOTHING),
        NOTHING if row.log10_probability is None else _power_text(row.log10_probability),
        interval,
    )


def _power_text(log10: float) -> str:
    """Ten to this power, also where that is too small for a double."""
    value = 10.0**log10
    return end_text(value) if value > 0.0 else f"1e{log10:.0f}"


def worst_table(
    tracks: Sequence[Track],
    by_rule: Mapping[str, Sequence[RankedRollout]],
    *,
    robustness_unit: str,
) -> str:
    """The least robust rollouts, of rules the first of each, and what they started with."""
    robustness = with_unit("robustness", robustness_unit)
    header = ("rank", robustness, "share", "misses", "in a row", "NLL [nats]", "which")
    rows = [
        (
            f"{rank}",
            _robustness(track.ranked),
            share_text(track.ranked.share),
            f"{track.ranked.misses}",
            f"{_most_in_a_row(track)}",
            f"{track.ranked.nll:.1f}",
            track.name,
        )
        for rank, track in enumerate(tracks, start=1)
    ]
    page = (
        "# Least robust rollouts\n\nFirst those that carry the estimate: with the largest "
        f"weights, {100 * CARRIED:g} % of it, each with its share. Misses: all of a rollout, also "
        "those that do not matter. NLL: how unlikely its outcomes are under the perception error "
        "model.\n\n" + markdown_table(header, rows)
    )
    if by_rule:
        of_rules = [
            (
                markdown_text(name),
                _robustness(one),
                share_text(one.share),
                f"repetition {one.repetition}, stage {one.stage}, rollout {one.rollout}",
            )
            for name, ranked in by_rule.items()
            for one in ranked[:RANKED_BY_RULE]
        ]
        page += "\n\n## Of each rule\n\nShares are of the answer to the rule.\n\n"
        page += markdown_table(("rule", robustness, "share", "which"), of_rules)
    starts = [(f"{i}", markdown_text(t.random.start_text)) for i, t in enumerate(tracks, start=1)]
    if any(words for _, words in starts):
        page += "\n\n## Random at the start\n\n"
        page += markdown_table(("rank", "started with"), starts)
    return page


def _most_in_a_row(track: Track) -> int:
    runs = groupby(track.detected.tolist())
    return max((len(list(run)) for detected, run in runs if not detected), default=0)


def _robustness(ranked: RankedRollout) -> str:
    return f"{ranked.robustness:.3g}{'' if ranked.violated else ' (holds)'}"


def config_document(result: RunResult) -> str:
    """The configuration as the run folder's ``config.toml`` has it."""
    return f"# config.toml\n\n```toml\n{config_text(result.config)}```"


def result_text(result: RunResult) -> str:
    """The result as the run folder's ``result.json`` has it."""
    return f"# result.json\n\n```json\n{json.dumps(result_document(result), indent=1)}\n```"


def contents_text(
    per_stage: int | None, *, repetitions: int, slots: Sequence[Slot], has_scene: bool
) -> str:
    """What this recording holds and leaves out."""
    lines = [quota_text(per_stage)]
    if repetitions > 1:
        lines.append(
            f"There are {repetitions} repetitions: rollouts, curves and stage figures are those "
            "of the first (number 0); estimates and the least robust rollouts are of all."
        )
    if slots:
        named = ", ".join(slot.name for slot in slots)
        lines.append(
            f"Perception answers for several things at every step: {named}. 'Detected' means here "
            "that it errs in none of them, 'missed' that it errs in one at least."
        )
    lines.append(
        "In each stage's plots, P(detected) of the proposal is the one that the stage's "
        "rollouts were sampled from. Where a proposal depends on more than the gap, its curve "
        "against gap is the average over the states near that gap in the stage's rollouts."
    )
    if has_scene:
        lines.append(SCENE_TEXT)
    lines.append(
        "Colours: blue holds or detected, orange violated or missed, yellow-orange the "
        "proposal, grey the perception error model."
    )
    return "# About this recording\n\n" + "\n\n".join(lines)
