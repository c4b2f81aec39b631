"""An evaluation as markdown, CSV, JSON and a picture of the reliability diagrams."""

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pemviz.pem.data.table import SalientTable
from pemviz.pem.judging.cross_validation import (
    PAPER_TABLE_1,
    ModelEvaluation,
    kept_whole,
)
from pemviz.pem.judging.scores import Scores

COLUMNS: tuple[str, ...] = (
    "model",
    "bce",
    "bce_std",
    "roc_auc",
    "roc_auc_std",
    "brier",
    "calibration_error",
    "fit_s",
    "paper_bce",
    "paper_roc_auc",
)


def write_report(
    evaluations: Sequence[ModelEvaluation], *, table: SalientTable, folder: Path
) -> tuple[Path, ...]:
    """Write evaluation.md, .csv, .json and reliability.png into a folder; gives their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = tuple(folder / f"evaluation.{ending}" for ending in ("md", "csv", "json"))
    paths[0].write_text(markdown(evaluations, table=table), encoding="utf-8")
    with paths[1].open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(summary_row(evaluation) for evaluation in evaluations)
    paths[2].write_text(
        json.dumps(as_json(evaluations, table=table), indent=1, allow_nan=False), encoding="utf-8"
    )
    picture = folder / "reliability.png"
    write_reliability(evaluations, picture)
    return (*paths, picture)


def summary_row(evaluation: ModelEvaluation) -> dict[str, Any]:
    """One line of the table; None where the paper gives no figure."""
    bce, auc = evaluation.bce, evaluation.roc_auc
    paper = PAPER_TABLE_1.get(evaluation.model, (None, None))
    values = (
        evaluation.model,
        *bce,
        *auc,
        evaluation.pooled.brier,
        evaluation.calibration_error,
        evaluation.fit_s,
        *paper,
    )
    return dict(zip(COLUMNS, values, strict=True))


def as_json(evaluations: Sequence[ModelEvaluation], *, table: SalientTable) -> dict[str, Any]:
    """Everything but the single obstacles' logits."""
    return {
        "schema": 1,
        "table": {"source": table.source, "digest": table.digest, "obstacles": len(table)},
        "models": [
            {
                **summary_row(evaluation),
                "folds": [asdict(fold) for fold in evaluation.folds],
                "pooled": asdict(evaluation.pooled),
                "reliability": [asdict(each) for each in evaluation.bins],
                "by_class": _plain(evaluation.by_class),
                "by_distance": _plain(evaluation.by_distance),
            }
            for evaluation in evaluations
        ],
    }


def markdown(evaluations: Sequence[ModelEvaluation], *, table: SalientTable) -> str:
    """The report as a page of markdown."""
    return "\n".join(_lines(evaluations, table=table)) + "\n"


def _lines(evaluations: Sequence[ModelEvaluation], *, table: SalientTable) -> Iterator[str]:
    missed = int((~table.detected).sum())
    folds = len(evaluations[0].folds) if evaluations else 0
    kind = "Stratified" if kept_whole(table) is None else "Over whole sequences of video,"
    yield "# Perception error models, cross-validated"
    yield ""
    yield (
        f"{len(table)} obstacles, {missed} missed; table `{table.source}`, SHA-256 "
        f"`{table.digest[:16]}`. {kind} {folds}-fold cross-validation: mean ± standard "
        "deviation between folds. The paper's figures are those of its Table I."
    )
    yield ""
    yield "| model | BCE | ROC-AUC | Brier | calibration error | paper BCE / ROC-AUC |"
    yield "|---|---|---|---|---|---|"
    for evaluation in evaluations:
        row = summary_row(evaluation)
        paper = "" if row["paper_bce"] is None else f"{row['paper_bce']} / {row['paper_roc_auc']}"
        yield (
            f"| {row['model']} | {row['bce']:.4f} ± {row['bce_std']:.4f} "
            f"| {row['roc_auc']:.4f} ± {row['roc_auc_std']:.4f} | {row['brier']:.4f} "
            f"| {row['calibration_error']:.4f} | {paper} |"
        )
    for title, groups in (
        ("class", [evaluation.by_class for evaluation in evaluations]),
        ("distance", [evaluation.by_distance for evaluation in evaluations]),
    ):
        yield ""
        yield f"## By {title}"
        yield ""
        yield from _group_lines(title, [each.model for each in evaluations], groups)
    yield ""
    yield "![Reliability diagrams](reliability.png)"


def _group_lines(
    title: str, models: Sequence[str], groups: Sequence[dict[str, Scores]]
) -> Iterator[str]:
    yield f"| {title} | obstacles | missed | " + " | ".join(f"BCE {m}" for m in models) + " |"
    yield "|---" * (3 + len(models)) + "|"
    for name, first in (groups[0] if groups else {}).items():
        scores = " | ".join(f"{group[name].bce:.4f}" for group in groups)
        yield f"| {name} | {first.obstacles} | {first.missed} | {scores} |"


def _plain(groups: dict[str, Scores]) -> dict[str, Any]:
    return {name: asdict(scores) for name, scores in groups.items()}


def write_reliability(evaluations: Sequence[ModelEvaluation], path: Path) -> None:
    """Observed against predicted P(missed) in bins of equal mass, both on log axes."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import)

    figure = Figure(figsize=(6.0, 5.0), layout="constrained")
    axes = figure.subplots()
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0, label="perfect")
    for evaluation in evaluations:
        axes.plot(
            [1.0 - each.predicted for each in evaluation.bins],
            [1.0 - each.observed for each in evaluation.bins],
            marker="o",
            markersize=3.5,
            linewidth=1.0,
            label=f"{evaluation.model} (error {evaluation.calibration_error:.4f})",
        )
    axes.set_xscale("symlog", linthresh=0.005)
    axes.set_yscale("symlog", linthresh=0.005)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("predicted P(missed)")
    axes.set_ylabel("share missed")
    axes.legend()
    figure.savefig(path, dpi=150)
