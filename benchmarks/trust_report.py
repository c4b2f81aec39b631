"""The study of trust in words: its cases, its table, a verdict for each bar."""

from collections.abc import Sequence

from benchmarks.accuracy_report import accuracy_lines
from benchmarks.trust_cases import TrustCase
from benchmarks.trust_study import TrustReport


def case_lines(cases: Sequence[TrustCase]) -> Sequence[str]:
    """A Markdown table of cases, their truths and how these were found."""
    lines = ["| case | specification | probability | found by |", "|---|---|---|---|"]
    for case in cases:
        error = f" +- {case.relative_error:.1%}" if case.relative_error else ""
        cells = (case.name, f"`{case.config.spec}`", f"{case.truth:.6g}{error}", case.source)
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def report_lines(report: TrustReport) -> Sequence[str]:
    """The table, which methods are left out where, and the verdicts."""
    refused: dict[str, list[str]] = {}
    for case, method in report.refused:
        refused.setdefault(method, []).append(case)
    return [
        *accuracy_lines(report.rows),
        "",
        *(f"{method} cannot be had for: {'; '.join(names)}" for method, names in refused.items()),
        *(
            f"{'met' if one.met else 'MISSED'}: {one.method}: {one.bar}: {one.figure}"
            for one in report.verdicts
        ),
    ]
