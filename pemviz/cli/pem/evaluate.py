"""``pemviz pem evaluate``."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pemviz.bars import progress_bar
from pemviz.cli.pem.checks import check_seed, feature_names
from pemviz.errors import PemError
from pemviz.files.text_files import writing
from pemviz.pem.data.table import load_table
from pemviz.pem.fitting.fit import MODEL_KINDS, ModelKind

OF_PAPER: ModelKind = "gb-paper"
QUICK_MODELS = ("guess-mu", "lr")
"""Fitted sooner than a process starts."""
SHOWN_COLUMNS = (
    "BCE", "ROC AUC", "Brier", "calibr.\nerror", "fit", "paper's\nBCE", "paper's\nROC AUC"
)  # fmt: skip
"""Beside the model."""


@dataclass(frozen=True)
class EvaluateArguments:
    """Cross-validate kinds of models and compare them with the paper's Table I."""

    table: Path
    """Data: CSV of 'pemviz pem collect', or a folder with salient_inputs.txt and
    salient_labels.txt."""
    out: Path = Path("pem-evaluation")
    """Folder for evaluation.md, .csv, .json and reliability.png."""
    models: tuple[ModelKind, ...] = MODEL_KINDS
    """Kinds of models to compare; b-nn needs pyro-ppl."""
    folds: int = 5
    """Number of folds (2 or more)."""
    seed: int = 0
    """Seed of the fits (0 or more)."""
    workers: int = 2
    """Folds fitted at once, each in its own process (1 to 64); the result is the same."""
    features: str = ""
    """Columns that P(missed) depends on, between commas, in place of the salient ones; as of
    'pemviz pem fit'. gb-paper, which sees the paper's columns, is then left out."""
    json: bool = False
    """Print the results as one JSON object instead of a table."""


def run(arguments: EvaluateArguments) -> int:
    """Fit, score, write; gives the exit code.

    Raises:
        PemError: bad arguments or table; one line says what, where and what is allowed.
    """
    _check(arguments)
    features = feature_names(arguments.features)
    table = load_table(arguments.table, features=features)
    models: tuple[ModelKind, ...] = arguments.models
    if features and models == MODEL_KINDS:
        models = tuple(kind for kind in MODEL_KINDS if kind != OF_PAPER)
    # scikit-learn and torch take seconds to import: not before the arguments are known good.
    from pemviz.pem.judging.cross_validation import (  # noqa: PLC0415
        as_json,
        cross_validate,
        split_folds,
        summary_row,
        write_report,
    )

    split_folds(table, folds=arguments.folds)
    with writing(arguments.out):  # now, not after minutes of fitting
        arguments.out.mkdir(parents=True, exist_ok=True)
    evaluations = []
    for model in models:
        with progress_bar(f"{model}: folds") as tell:
            evaluations.append(
                cross_validate(
                    table,
                    model=model,
                    folds=arguments.folds,
                    seed=arguments.seed,
                    workers=1 if model in QUICK_MODELS else arguments.workers,
                    on_progress=tell,
                )
            )
    with writing(arguments.out):
        written = write_report(evaluations, table=table, folder=arguments.out)
    if arguments.json:
        print(json.dumps(as_json(evaluations, table=table), allow_nan=False))
        return 0
    console = Console()
    title = f"{len(table)} obstacles, {arguments.folds}-fold cross-validation"
    console.print(_table([summary_row(evaluation) for evaluation in evaluations], title=title))
    console.print(f"written: {', '.join(str(path) for path in written)}")
    return 0


def _table(rows: Sequence[Mapping[str, Any]], *, title: str) -> Table:
    """The summary in eighty columns."""
    caption = escape("BCE [nats] and ROC AUC: mean ± deviation over folds; fit: seconds a fold")
    shown = Table(
        title=title, title_justify="left", caption=caption, caption_justify="left", box=None,
        pad_edge=False, collapse_padding=True,
    )  # fmt: skip
    shown.add_column("model", no_wrap=True)
    for column in SHOWN_COLUMNS:
        shown.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        shown.add_row(
            row["model"],
            f"{row['bce']:.4f} ± {row['bce_std']:.4f}",
            f"{_cell(row['roc_auc'])} ± {_cell(row['roc_auc_std'])}",
            f"{row['brier']:.4f}",
            f"{row['calibration_error']:.4f}",
            f"{row['fit_s']:.1f}",
            _cell(row["paper_bce"]),
            _cell(row["paper_roc_auc"]),
        )
    return shown


def _check(arguments: EvaluateArguments) -> None:
    if not arguments.models:
        raise PemError(f"models is empty, allowed: {', '.join(MODEL_KINDS)}")
    if arguments.features and OF_PAPER in arguments.models and arguments.models != MODEL_KINDS:
        raise PemError(f"models: {OF_PAPER} sees the paper's columns; with features use gb-raw")
    check_seed(arguments.seed)
    if not 1 <= arguments.workers <= 64:
        raise PemError(f"workers is {arguments.workers}, allowed: 1 to 64")


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
