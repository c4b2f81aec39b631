"""A result in a few lines, for a terminal or a notebook."""

from pemviz.config.tracker_text import NO_TRACKER
from pemviz.reports.causes_text import causes_line
from pemviz.reports.estimate_text import (
    interval_name,
    interval_text,
    memory_text,
    position_errors_text,
    probability_text,
    reference_text,
    violations_text,
)
from pemviz.reports.memory_curve import assumption_lines
from pemviz.reports.rates_text import rate_line
from pemviz.reports.starts_text import starts_lines
from pemviz.runs.result import RunResult
from pemviz.runs.trust import data_warnings, run_diagnostics, run_interval_caveats


def summary_text(result: RunResult) -> str:
    """Probability, interval, violations and every warning, for a terminal or a notebook."""
    name = f"{result.config.method} on {result.config.simulator}"
    if result.estimate is None:
        return f"{name}: no estimate, the run {result.status}"
    estimate, caveats = result.estimate, run_interval_caveats(result)
    called = interval_name(estimate, caveats=caveats)
    lines = [
        f"{name}: {probability_text(estimate)}",
        f"  {called}: {interval_text(estimate, caveats=caveats)}",
        f"  violations: {violations_text(estimate)}",
        *(f"  rule {rule.name}: {probability_text(rule.estimate)}" for rule in result.rules),
    ]
    if rate := rate_line(result):
        lines.append(f"  {rate}")
    if result.config.scenario.tracker != NO_TRACKER:
        lines.append(f"  tracker: {result.config.scenario.tracker}")
    if result.position_errors is not None:
        lines.append(f"  measured distance: {position_errors_text(result.position_errors)}")
    if result.latents is not None:
        lines.append(f"  latents: {result.latents}")
    if result.config.memory_s or result.config.frailty:
        lines.append(f"  misses: {memory_text(result.memory)}")
    if result.explanation is not None and result.explanation.slots:
        lines.append(f"  {causes_line(result.explanation)}")
    lines += [f"  {line}" for line in starts_lines(result)[:1]]
    lines += [f"  {assumed}" for assumed in assumption_lines(result.memory)]
    if result.reference is not None:
        lines.append(f"  reference: {reference_text(result.reference, estimate)}")
    about_answer = (diagnostic.text for diagnostic in run_diagnostics(result))
    about_rules = (f"rule {r.name}: {text}" for r in result.rules for text in r.estimate.warnings)
    warnings = (*about_answer, *about_rules, *data_warnings(result))
    return "\n".join([*lines, *(f"  warning: {warning}" for warning in warnings)])
