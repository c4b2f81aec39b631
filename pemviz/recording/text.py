"""The texts of a recording, as markdown."""

import json
from collections.abc import Mapping, Sequence

from pemviz.analysis.contribution import CARRIED
from pemviz.analysis.model_uncertainty import ModelInterval
from pemviz.config import ExperimentConfig
from pemviz.config.encounters import NO_FAMILY
from pemviz.config.toml_files import config_text
from pemviz.recording.latents import starts_table
from pemviz.recording.learning import StageFigures
from pemviz.recording.selection import Quota
from pemviz.recording.worst import Track, rules_table
from pemviz.reports.causes_text import BURST_COLUMNS, BURST_TITLE, burst_rows, causes_line
from pemviz.reports.data_plan_text import PLAN_TITLE, plan_heading, plan_sentences, short_rows
from pemviz.reports.digits import digits_of, end_text
from pemviz.reports.escape import markdown_table
from pemviz.reports.estimate_text import (
    REFITS,
    RELIABLE_TAIL,
    data_text,
    interval_name,
    memory_text,
    no_interval_text,
    share_text,
    short_probability,
)
from pemviz.reports.memory_curve import CURVE_AXES, assumption_lines, curve_columns, curve_rows
from pemviz.reports.rates_text import rates_markdown
from pemviz.reports.rules_text import RULE_COLUMNS, RULES_TITLE, rule_rows, rule_warnings
from pemviz.reports.starts_text import starts_markdown
from pemviz.reports.uncertainty_text import UNCERTAINTY_COLUMNS, UNCERTAINTY_TITLE, uncertainty_rows
from pemviz.runs.result import RankedRollout, RunResult
from pemviz.runs.result_file import result_document
from pemviz.runs.trust import data_warnings, run_diagnostics, run_interval_caveats
from pemviz.simulators.slots import Slot
from pemviz.types import Estimate

NOTHING = "none"
KINDS = {"pretrain": " (first)", "learn": "", "final": " (final)"}


def number(value: float | None, digits: int = 3) -> str:
    """A figure for a reader; 'none' where it is undefined."""
    return NOTHING if value is None else f"{value:.{digits}g}"


def answer_text(result: RunResult, *, running: bool) -> str:
    """The answer, its interval and diagnostics, and how to go on reading."""
    estimate, caveats = result.estimate, run_interval_caveats(result)
    parts = [
        _headline(result, caveats=caveats, running=running),
        *_status(result, running=running),
    ]
    if estimate is not None:
        parts += [*_rules(result), *rates_markdown(result, level="##")]
        parts += _next(result)
        sources = markdown_table(UNCERTAINTY_COLUMNS, uncertainty_rows(result))
        parts.append(f"## {UNCERTAINTY_TITLE}\n\n{sources}")
        parts += [*_memory(result), _model_range(result.pem_interval)]
        parts += [
            *_causes(result),
            *starts_markdown(result, level="##"),
            _diagnostics(estimate),
            *_plan(result),
        ]
    parts.append(_question(result))
    parts.append(
        "## How to read on\n"
        "- **Learning**: how the proposal came about, stage by stage.\n"
        "- **Rollouts**: what was simulated; orange curves violate the specification, blue "
        "ones do not, thick ones are the least robust.\n"
        "- **Worst case**: the least robust rollouts; press play to watch them.\n"
        "- **Config**: everything needed to run this again.\n\n"
        "The time panel below moves along a rollout (timelines `step` and `sim_time`). "
        "Choose `stage` there to replay the tab Learning."
    )
    return "\n\n".join(parts)


def _headline(result: RunResult, *, caveats: Sequence[str], running: bool) -> str:
    estimate, pem = result.estimate, result.pem
    if estimate is None:
        return "# The run goes on" if running else "# No estimate"
    interval = f"{_interval(estimate, caveats=caveats)}{_caution(estimate, caveats=caveats)}"
    if estimate.failures == 0:
        return f"# No violation was seen\n\n{interval}"
    probability = short_probability(estimate)
    if estimate.probability == 0.0 and estimate.log10_probability is not None:
        probability = f"10^{estimate.log10_probability:.1f}"
    family = result.config.encounter.family
    per = "run of the scenario" if family == NO_FAMILY else f"encounter of the family {family}"
    granted = (
        f"In one {per}, if error model **{pem.name}** is right, which learnt from "
        f"{data_text(pem)}, and misses are {memory_text(result.memory)}."
    )
    return f"# Probability of a violation: {probability}\n\n{granted}\n\n{interval}"


def _rules(result: RunResult) -> list[str]:
    """Each rule's answer, where there are several."""
    if not result.rules:
        return []
    lines = [f"- {text}" for text in rule_warnings(result)]
    rows = markdown_table(RULE_COLUMNS, rule_rows(result))
    title = f"## {RULES_TITLE}\n\nThe probability above is of any of them being broken."
    return [f"{title}\n\n{rows}", *(["\n".join(lines)] if lines else [])]


def _interval(estimate: Estimate, *, caveats: Sequence[str]) -> str:
    low, high = estimate.ci_low, estimate.ci_high
    if low is None or high is None:
        return "No interval is known."
    called = interval_name(estimate, caveats=caveats)
    digits = digits_of(low, high)
    ends = f"{end_text(low, digits=digits)} to {end_text(high, digits=digits)}"
    interval = f"{called[0].upper()}{called[1:]}: **{ends}**"
    if not caveats:
        return f"{interval}, sampling alone"
    return f"{interval}, **{no_interval_text(estimate)}**: {'; '.join(caveats)}"


def _model_range(interval: ModelInterval | None) -> str:
    if interval is None or interval.high is None:
        return f"Over refits of the error model ({REFITS}): unknown."
    low = "0" if interval.low is None else end_text(interval.low)
    return (
        f"Over {interval.members} {REFITS}: {interval.confidence:.0%} of them between "
        f"**{low} and {end_text(interval.high)}**"
    )


def _caution(estimate: Estimate, *, caveats: Sequence[str]) -> str:
    read = estimate.warnings or caveats
    return "\n\n**Read the warnings below before quoting this.**" if read else ""


def _status(result: RunResult, *, running: bool) -> list[str]:
    stages = len(result.stages)
    if running:
        return [f"Stages done so far: {stages}."]
    if result.status == "done":
        return []
    reason = f": {result.message}" if result.message else ""
    return [f"**The run {result.status}** after {stages} stages{reason}."]


def _next(result: RunResult) -> list[str]:
    """What to measure next, a line each, if it was asked for."""
    if result.plan is None:
        return []
    lines = "\n".join(f"- {collect}: {then}" for collect, then in short_rows(result))
    kind = plan_heading(result.plan).removeprefix(PLAN_TITLE).strip(" ()")
    return [f"## {PLAN_TITLE}", *([f"{kind[0].upper()}{kind[1:]}:"] if kind else []), lines]


def _plan(result: RunResult) -> list[str]:
    """The same in sentences, with what was seen so far."""
    if result.plan is None:
        return []
    sentences = "\n".join(f"- {words}" for words in plan_sentences(result))
    return [f"## {PLAN_TITLE}, in full\n{sentences}"]


def _diagnostics(estimate: Estimate) -> str:
    rows = [
        ("method", estimate.method),
        ("log10 of the probability", number(estimate.log10_probability, 4)),
        ("standard error", number(estimate.std_error)),
        ("rollouts simulated", f"{estimate.rollouts_simulated}"),
        ("rollouts in the estimate", f"{estimate.rollouts_in_estimate}"),
        ("of these, violations", f"{estimate.failures}"),
        ("effective sample size of their weights", number(estimate.ess)),
        ("largest weight's share", number(estimate.max_weight_share)),
        (f"Pareto k-hat {RELIABLE_TAIL}", number(estimate.pareto_k)),
        ("mean NLL of the violations [nats]", number(estimate.nll_mean, 4)),
        ("NLL of their mean likelihood [nats]", number(estimate.nll_log_mean, 4)),
    ]
    return _table(("figure", "value"), rows)


def _question(result: RunResult) -> str:
    config = result.config
    return (
        f"## What was asked\nHow likely is it that `{config.spec}` is violated, if perception "
        f"misses as the error model **{result.pem.name}** says? Scenario: {_scenario(config)}. "
        f"Rollouts are ranked by the {config.metric} robustness; whether one violates is decided "
        "by the formula itself."
    )


def _memory(result: RunResult) -> list[str]:
    """What the assumptions on misses are worth, and the answer over memory times and frailties."""
    memory = result.memory
    if memory is None:
        return []
    parts = [f"**{line}**" for line in assumption_lines(memory)]
    for axis in CURVE_AXES:
        rows = [
            (row.place, row.probability, row.interval, row.measured)
            for row in curve_rows(memory, axis)
        ]
        if rows:
            parts += [_table(curve_columns(memory, axis), rows), axis.note]
    return parts


def _causes(result: RunResult) -> list[str]:
    """Where misses lie before a violation, and how they hang together."""
    explanation = result.explanation
    if explanation is None:
        return []
    rows = burst_rows(explanation, target=result.config.target)
    table = [f"{BURST_TITLE}.", _table(BURST_COLUMNS, rows)] if rows else []
    return [f"## Misses that cause it\n\n{causes_line(explanation)}", *table]


def _scenario(config: ExperimentConfig) -> str:
    if not config.is_braking_scenario:
        return config.other_scenario
    return (
        f"{config.scenario.initial_speed_kmh:g} km/h, {config.scenario.initial_gap_m:g} m behind "
        f"a lead car that brakes at {config.scenario.lead_deceleration_mps2:g} m/s²"
    )


def warnings_text(result: RunResult) -> str:
    """What is wrong with the answer (bold) and with the error model, or that nothing is."""
    if result.message:
        return f"# Warnings\n\n- {result.message}"
    if result.estimate is None:
        return "# Warnings\n\nNone so far; there is no estimate yet."
    about_answer = (f"**{diagnostic.text}**" for diagnostic in run_diagnostics(result))
    warnings = (*about_answer, *data_warnings(result))
    if not warnings:
        return "# Warnings\n\nNone."
    return "# Warnings\n\n" + "\n".join(f"- {warning}" for warning in warnings)


def stage_table(rows: Sequence[StageFigures], *, robustness_unit: str) -> str:
    """Every stage's figures."""
    header = (
        "stage",
        f"threshold{_bracketed(robustness_unit)}",
        "learned from",
        "violations",
        "ESS",
        "loss [nats a step]",
        "estimate",
        "95 % interval",
    )
    note = (
        "Each stage's own estimate. Threshold: rollouts at or below it are learned from; so many "
        "are. ESS: how many equally weighted violations the estimate is worth. An interval in "
        "brackets is not a 95 % interval; why stands below.\n\n"
    )
    doubts = [f"- stage {row.stage}: {'; '.join(row.caveats)}" for row in rows if row.caveats]
    why = "\n\n## Why some are not 95 % intervals\n" + "\n".join(doubts) if doubts else ""
    return f"# Stages\n\n{note}" + _table(header, [_stage_row(row) for row in rows]) + why


def _stage_row(row: StageFigures) -> tuple[str, ...]:
    interval = "-"
    if row.log10_ci_low is not None and row.log10_ci_high is not None:
        interval = f"{power_text(row.log10_ci_low)} to {power_text(row.log10_ci_high)}"
    return (
        f"{row.stage}{KINDS[row.kind]}",
        number(row.threshold),
        f"{row.elites}" if row.elites else NOTHING,
        f"{row.failures} of {row.rollouts}",
        number(row.ess),
        number(row.loss),
        NOTHING if row.log10_probability is None else power_text(row.log10_probability),
        f"({interval})" if row.caveats and interval != "-" else interval,
    )


def power_text(log10: float) -> str:
    """Ten to this power, also where that is too small for a double."""
    value = 10.0**log10
    return end_text(value) if value > 0.0 else f"1e{log10:.0f}"


SCENE_TEXT = (
    "In the 3D scene all rollouts are seen from the ego car: its windscreen camera stands "
    "at 0 m and the lead car's rear at the gap."
)
ROADS_TEXT = (
    "On the roads the ego's centre stays at 0 m. A line around a car, in 3D a mark over it, "
    "tells what perception reports of it at the step: blue detected, orange missed (with a cross "
    "from above; larger in 3D), none or grey where there is nothing to report. White outlines and "
    "ellipses of two standard deviations: where the controller tracks a car. Grey cars: contact."
)


def worst_table(
    tracks: Sequence[Track], by_rule: Mapping[str, Sequence[RankedRollout]] | None = None
) -> str:
    """The least robust rollouts and, where there are rules, the first of each of them."""
    header = ("rank", "robustness", "share", "misses", "in a row", "NLL [nats]", "which")
    rows = [
        (
            f"{rank}",
            f"{track.ranked.robustness:.3g}{'' if track.ranked.violated else ' (holds)'}",
            share_text(track.ranked.share),
            f"{track.ranked.misses}",
            f"{longest_chain(track)}",
            f"{track.ranked.nll:.1f}",
            track.name,
        )
        for rank, track in enumerate(tracks, start=1)
    ]
    starts = starts_table([track.random for track in tracks])
    return (
        "# Least robust rollouts\n\nFirst those that carry the estimate: with the largest "
        f"weights, {100 * CARRIED:g} % of it, each with its share. Misses: all of a rollout, also "
        "those that do not matter. NLL: how unlikely its outcomes are under the perception error "
        "model.\n\n" + _table(header, rows) + rules_table(by_rule or {}) + starts
    )


def longest_chain(track: Track) -> int:
    """Most misses in a row."""
    longest = current = 0
    for detected in track.detected.tolist():
        current = 0 if detected else current + 1
        longest = max(longest, current)
    return longest


def config_document(result: RunResult) -> str:
    """The configuration as the run folder's ``config.toml`` has it."""
    return f"# config.toml\n\n```toml\n{config_text(result.config)}```"


def result_text(result: RunResult) -> str:
    """The result as the run folder's ``result.json`` has it."""
    return f"# result.json\n\n```json\n{json.dumps(result_document(result), indent=1)}\n```"


def provenance_text(result: RunResult) -> str:
    """Where the numbers come from and what they assume."""
    versions = _table(("package", "version"), list(result.versions.items()))
    timings = _table(
        ("part", "seconds"), [(part, f"{s:.2f}") for part, s in result.timings_s.items()]
    )
    assumptions = "\n".join(f"- {assumption}" for assumption in result.assumptions)
    return (
        f"# Provenance\n\nRun **{result.run_id}**, seed {result.config.seed}.\n\n"
        f"Perception error model **{result.pem.name}**, trained on: {result.pem.data} "
        f"(SHA-256 `{result.pem.digest}`).\n\n## Assumed\n{assumptions}\n\n"
        f"## Versions\n{versions}\n\n## Wall time\n{timings}"
    )


def contents_text(
    quota: Quota, *, repetitions: int, slots: Sequence[Slot] = (), on_roads: bool = False
) -> str:
    """What this recording holds and leaves out."""
    lines = [quota.describe()]
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
    lines.append(ROADS_TEXT if on_roads else SCENE_TEXT)
    lines.append(
        "Colours: blue holds or detected, orange violated or missed, yellow-orange the "
        "proposal, grey the perception error model."
    )
    return "# About this recording\n\n" + "\n\n".join(lines)


def _bracketed(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [_row(header), _row(["---"] * len(header)), *(_row(row) for row in rows)]
    return "\n".join(lines)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
