"""The summary at the end of a run."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pemviz.analysis.data_plan import DataPlan
from pemviz.analysis.explanation import Explanation
from pemviz.analysis.sensitivity import BandSensitivity
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.reports.causes_text import (
    BURST_COLUMNS,
    BURST_TITLE,
    SHOWN_MISSES,
    burst_lines,
    burst_rows,
    causes_line,
    elasticity_text,
)
from pemviz.reports.data_plan_text import (
    BAND_COLUMNS,
    band_rows,
    plan_heading,
    short_rows,
)
from pemviz.reports.estimate_text import (
    RELIABLE_TAIL,
    aimed_text,
    data_text,
    interval_name,
    interval_text,
    memory_text,
    model_range_text,
    number_text,
    occasion_text,
    position_errors_text,
    probability_text,
    reference_text,
    share_text,
    short_probability,
    violations_text,
)
from pemviz.reports.memory_curve import (
    BY_MEMORY_TIME,
    CURVE_AXES,
    CurveAxis,
    assumption_lines,
    curve_columns,
    curve_rows,
)
from pemviz.reports.rates_text import rate_columns, rate_line, rate_rows, rates_title
from pemviz.reports.rules_text import RULE_COLUMNS, RULES_TITLE, rule_rows, rule_warnings
from pemviz.reports.starts_text import (
    START_COLUMNS,
    STARTS_TITLE,
    start_rows,
    starts_lines,
    starts_title,
)
from pemviz.reports.uncertainty_text import UNCERTAINTY_COLUMNS, UNCERTAINTY_TITLE, uncertainty_rows
from pemviz.runs.memory import RunMemory
from pemviz.runs.result import RunResult
from pemviz.runs.trust import data_warnings, run_diagnostics, run_interval_caveats
from pemviz.sampling.estimates.trust import remedy
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

MOST_WARNINGS = 5


def print_summary(result: RunResult, folder: Path, *, verbose: bool = False) -> None:
    """Print the answer, how far it is open, what causes violations, and where the run lies.

    Args:
        result: What was found.
        folder: The run's.
        verbose: With every figure and every warning, not only the gravest.
    """
    console = Console(highlight=False)
    if result.estimate is not None:
        if verbose:
            console.print(_table(result, result.estimate))
        else:
            for line in headline(result, result.estimate):
                console.print(line, markup=False, soft_wrap=True)
        if result.rules:
            console.print(_rows(RULES_TITLE, RULE_COLUMNS, rule_rows(result)))
        if len(rates := rate_rows(result)) > 1 or (rates and verbose):
            console.print(_rows(rates_title(result), rate_columns(result), rates))
        _print_memory(console, result.memory, verbose=verbose)
        console.print(UNCERTAINTY_TITLE, style="italic", markup=False)
        console.print(_uncertainty(result))
        if result.plan is not None:
            _print_plan(console, result, result.plan, verbose=verbose)
        if result.explanation is not None and (verbose or result.config.target is not None):
            console.print(_causes(result.explanation, target=result.config.target))
            console.print(_bursts(result.explanation, target=result.config.target))
        elif result.explanation is not None:
            for line in (causes_line(result.explanation), *burst_lines(result.explanation)):
                console.print(line, markup=False, soft_wrap=True)
        _print_starts(console, result, verbose=verbose)
        for line in warning_lines(result, verbose=verbose):
            console.print(line, style="yellow", markup=False, soft_wrap=not verbose)
    console.print(f"run folder: {folder}", markup=False, soft_wrap=True)


def headline(result: RunResult, estimate: Estimate) -> Iterator[str]:
    """How likely a violation is, by what method, and what it takes for granted."""
    config, caveats = result.config, run_interval_caveats(result)
    repeated = f" in {len(result.repetitions)} repetitions" * (len(result.repetitions) > 1)
    likely = short_probability(estimate)
    per = f"in one {occasion_text(config)}, if error model {result.pem.name} is right"
    yield f"Failure probability {likely} {per}"
    called = interval_name(estimate, caveats=caveats)
    alone = "" if caveats else ", sampling alone; what else leaves it open is below"
    yield f"  {called} {interval_text(estimate, caveats=caveats)}{alone}"
    what = f"any of {len(config.rules)} rules" if config.rules else config.spec
    yield (
        f"  {config.method}{repeated}: {violations_text(estimate)}{aimed_text(estimate)} violate "
        f"{what}; took {result.timings_s.get('total', math.nan):.1f} s"
    )
    if caveats:
        yield f"  try next: {remedy(estimate.method, latents=result.latents is not None)}"
    if rate := rate_line(result):
        yield f"  {rate}"
    if result.reference is not None:
        yield f"  reference {reference_text(result.reference, estimate)}"
    yield f"  {result.pem.name} learnt from {data_text(result.pem)}"
    yield f"  misses {memory_text(result.memory)}"
    if config.scenario.tracker != NO_TRACKER:
        yield f"  tracker between perception and controller: {config.scenario.tracker}"
    if result.position_errors is not None:
        yield f"  measured distance: {position_errors_text(result.position_errors)}"
    if result.latents is not None:
        yield f"  latents (standard normals): {result.latents}"


def _rows(title: str, columns: Sequence[str], rows: Sequence[tuple[str, ...]]) -> Table:
    """Texts as a table without lines."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def _uncertainty(result: RunResult) -> Table:
    """What leaves the answer open, a row each."""
    table = Table(box=None, pad_edge=False)
    for column, justify in zip(
        UNCERTAINTY_COLUMNS, ("left", "right", "right", "left"), strict=True
    ):
        table.add_column(column, justify=justify, no_wrap=justify == "right")
    for row in uncertainty_rows(result):
        table.add_row(*row)
    return table


def _print_plan(console: Console, result: RunResult, plan: DataPlan, *, verbose: bool) -> None:
    """What to measure next, and with ``verbose`` the labels by band."""
    console.print(plan_heading(plan), style="italic", markup=False, soft_wrap=True)
    if plan.reason is not None:
        console.print(f"no labels are planned: {plan.reason}", markup=False, soft_wrap=True)
    for collect, then in short_rows(result):
        console.print(f"- {collect}: {then}", markup=False, soft_wrap=True)
    if plan.labels is not None and verbose:
        title = f"Labels that show less than {plan.labels.target:.2g}, and P(missed)"
        table = Table(title=title, title_justify="left", box=None, pad_edge=False)
        for column in BAND_COLUMNS:
            table.add_column(escape(column), justify="right")
        for row in band_rows(plan.labels):
            table.add_row(*row)
        console.print(table)


def _print_starts(console: Console, result: RunResult, *, verbose: bool) -> None:
    """A sentence on the starts of violations, and with ``verbose`` the figures."""
    for line in starts_lines(result)[: None if verbose else 1]:
        console.print(line, markup=False, soft_wrap=True)
    for found in result.starts if verbose else ():
        title = f"{STARTS_TITLE}: {starts_title(found)}"
        console.print(_rows(title, START_COLUMNS, start_rows(found)))


def warning_lines(result: RunResult, *, verbose: bool) -> list[str]:
    """Warnings, the gravest first: at most five lines unless all are asked for."""
    about_answer = [diagnostic.text for diagnostic in run_diagnostics(result)]
    about_refits = () if result.pem_interval is None else result.pem_interval.warnings
    about_data = [text for text in data_warnings(result) if text not in about_refits]
    if verbose:
        every = (*about_answer, *rule_warnings(result), *about_refits, *about_data)
        return [f"warning: {text}" for text in every]
    grave = (*about_answer, *rule_warnings(result), *about_refits)
    shown = grave[: MOST_WARNINGS - 1]
    lines = [f"warning: {text}" for text in shown]
    kinds = Counter(text.partition(":")[0] if ":" in text[:40] else "others" for text in about_data)
    kinds["more about the answer"] = len(grave) - len(shown)
    named = [f"{kind} ({count})" if count > 1 else kind for kind, count in kinds.items() if count]
    if named:
        lines.append(f"warning: {', '.join(named)}; --verbose tells each")
    return lines


def _table(result: RunResult, estimate: Estimate) -> Table:
    table = Table(title="Failure probability", title_justify="left", show_header=False)
    table.add_column("what", no_wrap=True)
    table.add_column("value")
    config = result.config
    repetitions = len(result.repetitions)
    table.add_row("specification", config.spec)
    table.add_row(
        "method",
        f"{config.method} ({repetitions} repetitions)" * (repetitions > 1) or config.method,
    )
    table.add_row("error model", result.pem.name)
    table.add_row("probability", probability_text(estimate))
    caveats = run_interval_caveats(result)
    called = interval_name(estimate, caveats=caveats)
    table.add_row(called, interval_text(estimate, caveats=caveats))
    table.add_row("misses", memory_text(result.memory))
    if result.reference is not None:
        table.add_row("reference", reference_text(result.reference, estimate))
    table.add_row("range over refits", model_range_text(result.pem_interval))
    table.add_row("violations", violations_text(estimate))
    table.add_row("NLL of violations", number_text(estimate.nll_mean, unit="nats (mean)"))
    if by_name(estimate.method).rests_on_weights:
        table.add_row("effective sample size", number_text(estimate.ess))
        table.add_row("Pareto k-hat", number_text(estimate.pareto_k, unit=RELIABLE_TAIL))
        table.add_row("largest weight's share", share_text(estimate.max_weight_share))
    worst = result.least_robust[0] if result.least_robust else None
    if worst is not None:
        table.add_row(
            "least robust rollout",
            f"robustness {worst.robustness:.3g}, {worst.misses} misses, stage {worst.stage}"
            + ("" if worst.share is None else f", {share_text(worst.share)} of the estimate"),
        )
    table.add_row("time", f"{result.timings_s.get('total', math.nan):.1f} s")
    return table


def _print_memory(console: Console, memory: RunMemory | None, *, verbose: bool) -> None:
    """What the assumptions on misses are worth, if it was asked."""
    if memory is None:
        return
    for line in assumption_lines(memory):
        console.print(line, style="bold", markup=False)
    for axis in CURVE_AXES if verbose else (BY_MEMORY_TIME,):
        if axis.points(memory):
            console.print(_curve(memory, axis))


def _curve(memory: RunMemory, axis: CurveAxis) -> Table:
    """The failure probability along an axis."""
    table = Table(
        title=axis.title, title_justify="left", caption=axis.note, caption_justify="left",
    )  # fmt: skip
    sides = ("right", "right", "left", "left")
    for column, justify in zip(curve_columns(memory, axis), sides, strict=True):
        table.add_column(column, justify=justify)
    for row in curve_rows(memory, axis):
        table.add_row(row.place, row.probability, row.interval, row.measured)
    return table


def _causes(explanation: Explanation, *, target: float | None) -> Table:
    """Where misses cause violations, and by how much they would have to become rarer."""
    table = Table(title="Misses that cause it, by gap", title_justify="left")
    table.add_column("gap")
    table.add_column("misses a violation", justify="right")
    table.add_column("sensitivity", justify="right")
    if target is not None:
        table.add_column(f"factor on misses for {target:g}", justify="right")
    everywhere, *bands = explanation.sensitivity
    total = sum(band.misses for band in explanation.misses_by_distance)
    for misses, band in zip(explanation.misses_by_distance, bands, strict=True):
        if misses.misses > SHOWN_MISSES:
            row = _band_row(f"{misses.low:g} to {misses.high:g} m", misses.misses, band, target)
            table.add_row(*row)
    table.add_row(*_band_row("all", total, everywhere, target), end_section=True)
    return table


def _bursts(explanation: Explanation, *, target: float | None) -> Table:
    """How misses hang together before a violation."""
    table = Table(title=BURST_TITLE, title_justify="left")
    for column in BURST_COLUMNS:
        table.add_column(column)
    for row in burst_rows(explanation, target=target):
        table.add_row(*row)
    return table


def _band_row(
    name: str, misses: float, band: BandSensitivity, target: float | None
) -> tuple[str, ...]:
    row = (name, f"{misses:.2f}", elasticity_text(band))
    if target is None:
        return row
    return (*row, "not enough alone" if band.target_factor is None else f"{band.target_factor:.3g}")
