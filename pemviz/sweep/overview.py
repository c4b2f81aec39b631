"""A sweep's overview recording, from what its runs found."""

import math
import os
from collections.abc import Sequence
from pathlib import Path

from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_text
from pemviz.recording.sweep_overview import (
    SweepEstimate,
    SweepSetting,
    SweepTexts,
    write_sweep_overview,
)
from pemviz.reports.escape import markdown_block, markdown_table, markdown_text
from pemviz.reports.estimate_words import interval_text, level_text, number_text
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sweep.carry_out import RunState
from pemviz.sweep.plan import Plan, setting_label, value_text
from pemviz.sweep.tables import by_setting

MOST_ROWS = 2000


def write_overview(
    path: Path, plan: Plan, states: Sequence[RunState], *, base: ExperimentConfig, summary: str
) -> None:
    """Write the recording, with the summary's page; whole or not at all.

    Raises:
        OSError: It cannot be put in its place.
        RunError: It cannot be written.
    """
    settings = [
        SweepSetting(
            title=setting_label(setting) or "all seeds",
            estimates=tuple(map(_estimate, of_it)),
        )
        for setting, of_it in by_setting(states).items()
    ]
    texts = SweepTexts(
        summary=summary,
        runs=_runs_page(plan, states),
        settings=_settings_page(plan, base),
    )
    partial = path.with_name(f".{path.name}.partial")
    try:
        write_sweep_overview(partial, settings, texts, name=f"sweep {path.parent.name}")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _estimate(state: RunState) -> SweepEstimate:
    estimate = state.estimate
    seed = state.planned.config.seed
    if estimate is None:
        return SweepEstimate(seed, None, note=state.message or state.status)
    if estimate.log10_probability is None:
        return SweepEstimate(seed, None, note="no violation seen")
    low, high = (
        math.log10(end) if end is not None and end > 0.0 else None
        for end in (estimate.ci_low, estimate.ci_high)
    )
    caveats = interval_caveats(estimate)
    return SweepEstimate(seed, estimate.log10_probability, low, high, caveats=caveats)


def _runs_page(plan: Plan, states: Sequence[RunState]) -> str:
    header = (*plan.fields, "seed", "probability", "interval", "violations", "ESS", "status")
    rows = [_run_row(state) for state in states[:MOST_ROWS]]
    left_out = len(states) - len(rows)
    more = f"\n\n{left_out} more are in sweep.csv." if left_out else ""
    return f"# Runs\n\n{markdown_table(header, rows)}{more}"


def _run_row(state: RunState) -> tuple[str, ...]:
    planned, estimate = state.planned, state.estimate
    head = (*(value_text(value) for _, value in planned.setting), str(planned.config.seed))
    status = state.status if state.message is None else f"{state.status}: {state.message}"
    if estimate is None:
        return (*map(markdown_text, head), "", "", "", "", markdown_text(status))
    caveats = interval_caveats(estimate)
    interval = interval_text(estimate, caveats=caveats)
    level = "" if caveats or estimate.ci_high is None else f" ({level_text(estimate)})"
    return (
        *map(markdown_text, head),
        number_text(estimate.probability),
        markdown_text(f"{interval}{level}"),
        str(estimate.failures),
        number_text(estimate.ess),
        status,
    )


def _settings_page(plan: Plan, base: ExperimentConfig) -> str:
    varied = [
        f"- {markdown_text(one.field)}: {markdown_text(', '.join(map(value_text, one.values)))}"
        for one in plan.variations
    ]
    listed = "\n".join(varied) or "- nothing but the seed"
    shared = markdown_block(config_text(base), language="toml")
    return f"# Settings\n\nVaried:\n\n{listed}\n\nAll else, and the first seed:\n\n{shared}"
