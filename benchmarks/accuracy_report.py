"""The accuracy study as a table, as JSON and as a picture."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.accuracy import Accuracy

HEADER = (
    "scenario",
    "method",
    "rollouts",
    "runs",
    "truth",
    "relative RMSE",
    "median ratio",
    "interval covers",
    "warned",
    "warned within 10 %",
    "covers unwarned",
    "off by over 2 unwarned",
    "wall time [s]",
)


def accuracy_lines(rows: Sequence[Accuracy]) -> Sequence[str]:
    """A Markdown table."""
    lines = ["| " + " | ".join(HEADER) + " |", "|" + "---|" * len(HEADER)]
    for row in rows:
        cells = (
            row.scenario,
            row.method,
            f"{row.rollouts}",
            f"{row.runs}",
            "" if row.truth is None else f"{row.truth:.4g}",
            f"{row.relative_rmse:.2%}",
            f"{row.median_ratio:.3f}",
            _share(row.coverage, row.coverage_low, row.coverage_high),
            f"{row.warned:.1%}",
            "-" if row.close_warned is None else f"{row.close_warned:.1%}",
            _share(row.unwarned_coverage, row.unwarned_coverage_low, row.unwarned_coverage_high),
            f"{row.misleading:.1%}",
            f"{row.median_wall_s:.2f}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _share(share: float | None, low: float | None, high: float | None) -> str:
    if share is None or low is None or high is None:
        return "-"
    return f"{share:.1%} ({low:.1%} to {high:.1%})"


def write_accuracy(rows: Sequence[Accuracy], folder: Path) -> Sequence[Path]:
    """Write ``accuracy.md``, ``accuracy.json`` and ``accuracy.png`` into ``folder``.

    Raises:
        OSError: The folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table, data, picture = (folder / f"accuracy.{kind}" for kind in ("md", "json", "png"))
    table.write_text("\n".join(accuracy_lines(rows)) + "\n", encoding="utf-8")
    document = {"schema": 1, "rows": [asdict(row) for row in rows]}
    data.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    _draw(rows, picture)
    return table, data, picture


def _draw(rows: Sequence[Accuracy], path: Path) -> None:
    """Relative RMSE and coverage, a bar a row, the error on a logarithmic axis."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  slow to import
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(10.0, 1.5 + 0.35 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    error, coverage = figure.subplots(1, 2, sharey=True)
    places = list(range(len(rows)))
    names = [f"{row.scenario}, {row.method}, {row.rollouts}" for row in rows]
    error.barh(places, [max(row.relative_rmse, 1e-6) for row in rows])
    error.set_xscale("log")
    error.set_xlabel("relative RMSE")
    error.set_yticks(places, names)
    error.invert_yaxis()
    coverage.errorbar(
        [row.coverage for row in rows],
        places,
        xerr=[
            [row.coverage - row.coverage_low for row in rows],
            [row.coverage_high - row.coverage for row in rows],
        ],
        fmt="o",
    )
    coverage.axvline(0.95, color="grey", linestyle="--")
    coverage.set_xlabel("share of intervals, warned or not, that contain the truth")
    figure.savefig(path, dpi=120)
