"""A run's answer in a few lines of plain text."""

from pemviz.reports.words import (
    interval_text,
    probability_text,
    reference_text,
    violations_text,
)
from pemviz.runs.result import RunResult


def summary_text(result: RunResult) -> str:
    """Probability, interval, violations and every warning, for a terminal or a notebook."""
    name = f"{result.config.method} on {result.config.simulator}"
    if result.estimate is None:
        return f"{name}: no estimate, the run {result.status}"
    estimate = result.estimate
    lines = [
        f"{name}: {probability_text(estimate)}",
        f"  95 % interval: {interval_text(estimate)}",
        f"  violations: {violations_text(estimate)}",
    ]
    if result.reference is not None:
        lines.append(f"  reference: {reference_text(result.reference, estimate)}")
    warnings = (*estimate.warnings, *result.warnings)
    return "\n".join([*lines, *(f"  warning: {warning}" for warning in warnings)])
