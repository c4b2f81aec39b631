"""``pemviz pem evaluate``."""

import json
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from pemviz.cli.pem.progress import progress_bar
from pemviz.errors import PemError
from pemviz.files.text_files import writing
from pemviz.pem.data.table import load_table
from pemviz.pem.fitting.fit import MODEL_KINDS, ModelKind

QUICK_MODELS = ("guess-mu", "lr")
"""Fitted sooner than a process starts."""


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
    json: bool = False
    """Print the results as one JSON object instead of a table."""


def run(arguments: EvaluateArguments) -> int:
    """Fit, score, write; gives the exit code.

    Raises:
        PemError: bad arguments or table; one line says what, where and what is allowed.
    """
    _check(arguments)
    table = load_table(arguments.table)
    # scikit-learn and torch take seconds to import: not before the arguments are known good.
    from pemviz.pem.judging.cross_validation import cross_validate, split_folds  # noqa: PLC0415
    from pemviz.pem.judging.report import COLUMNS, as_json, summary_row, write_report  # noqa: PLC0415

    split_folds(table, folds=arguments.folds)
    with writing(arguments.out):  # now, not after minutes of fitting
        arguments.out.mkdir(parents=True, exist_ok=True)
    evaluations = []
    for model in arguments.models:
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
    shown = Table(title=f"{len(table)} obstacles, {arguments.folds}-fold cross-validation")
    for column in COLUMNS:
        shown.add_column(column, justify="left" if column == "model" else "right")
    for evaluation in evaluations:
        shown.add_row(*(_cell(value) for value in summary_row(evaluation).values()))
    console = Console()
    console.print(shown)
    console.print(f"written: {', '.join(str(path) for path in written)}")
    return 0


def _check(arguments: EvaluateArguments) -> None:
    if not arguments.models:
        raise PemError(f"models is empty, allowed: {', '.join(MODEL_KINDS)}")
    if arguments.seed < 0:
        raise PemError(f"seed is {arguments.seed}, allowed: 0 or more")
    if not 1 <= arguments.workers <= 64:
        raise PemError(f"workers is {arguments.workers}, allowed: 1 to 64")


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.4f}" if isinstance(value, float) else str(value)
