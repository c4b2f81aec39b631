"""The summary at the end of a run."""

import math
from pathlib import Path

from rich.console import Console
from rich.table import Table

from pemviz.analysis.explanation import Explanation
from pemviz.analysis.sensitivity import BandSensitivity
from pemviz.reports.estimate_text import (
    RELIABLE_TAIL,
    interval_name,
    interval_text,
    memory_text,
    model_range_text,
    number_text,
    probability_text,
    reference_text,
    share_text,
    violations_text,
)
from pemviz.reports.memory_curve import assumption_line, curve_rows
from pemviz.runs.memory import RunMemory
from pemviz.runs.result import RunResult
from pemviz.runs.trust import data_warnings, run_diagnostics, run_interval_caveats
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

SHOWN_MISSES = 0.005


def print_summary(result: RunResult, folder: Path) -> None:
    """Print the answer, how far to trust it, and where the run lies."""
    console = Console(highlight=False)
    if result.estimate is not None:
        console.print(_table(result, result.estimate))
        if result.memory is not None and result.memory.curve:
            console.print(assumption_line(result.memory), style="bold", markup=False)
            console.print(_memory(result.memory))
        if result.explanation is not None:
            console.print(_causes(result.explanation, target=result.config.target))
        about_answer = (diagnostic.text for diagnostic in run_diagnostics(result))
        for warning in (*about_answer, *data_warnings(result)):
            console.print(f"warning: {warning}", style="yellow", markup=False)
    console.print(f"run folder: {folder}", markup=False, soft_wrap=True)


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
            f"robustness {worst.robustness:.3g}, {worst.misses} misses, stage {worst.stage}",
        )
    table.add_row("time", f"{result.timings_s.get('total', math.nan):.1f} s")
    return table


def _memory(memory: RunMemory) -> Table:
    """The failure probability over memory times."""
    table = Table(title="If misses come in bursts, by memory time", title_justify="left")
    table.add_column("memory time", justify="right")
    table.add_column("probability", justify="right")
    table.add_column("95 % interval")
    table.add_column("measured on video for")
    for row in curve_rows(memory):
        table.add_row(row.tau, row.probability, row.interval, row.measured)
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


def _band_row(
    name: str, misses: float, band: BandSensitivity, target: float | None
) -> tuple[str, ...]:
    elasticity = "-" if band.elasticity is None else f"{band.elasticity:.2f}"
    row = (name, f"{misses:.2f}", elasticity)
    if target is None:
        return row
    return (*row, "not enough alone" if band.target_factor is None else f"{band.target_factor:.3g}")
