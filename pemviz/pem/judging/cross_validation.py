"""Cross-validated scores of every kind of model, the paper's Table I and beyond, and their report.

A report is markdown, CSV, JSON and a picture of the reliability diagrams.
"""

import csv
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.support import DISTANCE_EDGES_M, band_in_words
from pemviz.pem.data.table import SalientTable
from pemviz.pem.fitting.fit import ModelKind, fit_pem
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN
from pemviz.processes import map_in_processes

RELIABILITY_BINS = 15
PAPER_TABLE_1: dict[ModelKind, tuple[float, float]] = {
    "guess-mu": (0.260, 0.5),
    "lr": (0.244, 0.688),
    "ml-nn": (0.226, 0.777),
    "b-nn": (0.238, 0.726),
}
"""(binary cross-entropy, ROC-AUC) as printed in the paper's Table I."""
NO_FIGURES = (None, None)
COLUMNS = (
    *("model", "bce", "bce_std", "roc_auc", "roc_auc_std", "brier", "calibration_error"),
    *("fit_s", "paper_bce", "paper_roc_auc"),
)


@dataclass(frozen=True)
class ReliabilityBin:
    """Obstacles of similar predicted probability: its mean, and the share that was detected."""

    obstacles: int
    predicted: float
    observed: float


@dataclass(frozen=True)
class Scores:
    """Scores of one model on one set of obstacles; without a ROC-AUC if only one outcome occurs."""

    obstacles: int
    missed: int
    bce: float
    """Binary cross-entropy [nats per obstacle]."""
    roc_auc: float | None
    brier: float
    mean_miss: float
    """Mean predicted P(missed)."""


def score(logit: FloatArray, detected: BoolArray) -> Scores:
    """All scores of logits [n] against outcomes [n]."""
    probability = expit(logit)
    missed = int((~detected).sum())
    positives = len(detected) - missed
    area = None
    if positives and missed:
        from scipy.stats import rankdata  # noqa: PLC0415  slow to import

        # by ranks (Mann and Whitney), ties counting half
        rank_sum = float(rankdata(logit)[detected].sum())
        area = (rank_sum - positives * (positives + 1) / 2.0) / (positives * missed)
    return Scores(
        obstacles=len(detected),
        missed=missed,
        bce=float(np.mean(np.logaddexp(0.0, np.where(detected, -logit, logit)))),
        roc_auc=area,
        brier=float(np.mean((probability - detected) ** 2)),
        mean_miss=float(np.mean(expit(-logit))),
    )


def reliability(
    logit: FloatArray, detected: BoolArray, *, bins: int = RELIABILITY_BINS
) -> tuple[ReliabilityBin, ...]:
    """Bins of equal numbers of obstacles, in order of predicted probability; arrays [n]."""
    order: IntArray = np.argsort(logit, kind="stable")
    probability = expit(logit)
    return tuple(
        ReliabilityBin(
            obstacles=len(rows),
            predicted=float(probability[rows].mean()),
            observed=float(detected[rows].mean()),
        )
        for rows in np.array_split(order, bins)
        if len(rows)
    )


def calibration_error(bins: tuple[ReliabilityBin, ...]) -> float:
    """Expected calibration error: mean gap of predicted and observed, weighted by obstacles."""
    total = sum(each.obstacles for each in bins)
    gaps = sum(each.obstacles * abs(each.predicted - each.observed) for each in bins)
    return gaps / total


@dataclass(frozen=True, eq=False)
class ModelEvaluation:
    """Scores of one kind of model, each obstacle judged by a fit that had not seen it."""

    model: ModelKind
    folds: tuple[Scores, ...]
    """Scores on each held-out part."""
    pooled: Scores
    calibration_error: float
    """Expected calibration error over all obstacles, 15 bins of equal mass."""
    bins: tuple[ReliabilityBin, ...]
    by_class: dict[str, Scores]
    by_distance: dict[str, Scores]
    fit_s: float
    """Mean time to fit one fold [s]."""
    logit: FloatArray
    """Held-out logits, shape [n]."""

    @property
    def bce(self) -> tuple[float, float]:
        """Mean over folds of the cross-entropy, and its standard deviation between folds."""
        return _mean_and_spread([fold.bce for fold in self.folds])

    @property
    def roc_auc(self) -> tuple[float, float]:
        """Mean over folds of the ROC-AUC, and its standard deviation between folds."""
        return _mean_and_spread(
            [np.nan if fold.roc_auc is None else fold.roc_auc for fold in self.folds]
        )


def kept_whole(table: SalientTable) -> IntArray | None:
    """Sequences of video ``[n]`` that folds must not part; None where there are not several."""
    sequence = table.sequence
    return None if sequence is None or np.unique(sequence).size == 1 else sequence


def split_folds(table: SalientTable, *, folds: int) -> list[tuple[IntArray, IntArray]]:
    """Training and held-out rows of stratified folds, in the table's order without shuffling.

    As the paper's authors did; rows of one image, which stand together, mostly share a fold. On
    video the folds are of whole sequences: one car's frames are too much alike to be parted.

    Raises:
        PemError: fewer obstacles of one outcome, or fewer sequences, than folds.
    """
    # slow to import
    from sklearn.model_selection import GroupKFold, StratifiedKFold  # noqa: PLC0415

    table.check_outcomes()
    sequence = kept_whole(table)
    if sequence is not None:
        sequences = int(np.unique(sequence).size)
        if not 2 <= folds <= sequences:
            raise PemError(f"folds is {folds}, allowed: 2 to {sequences} (sequences)")
        parts = list(GroupKFold(folds).split(table.salient, groups=sequence))
        if not _have_outcomes(table, parts):
            raise PemError(_lacking_outcome(table, sequence, folds=folds))
        return parts
    rarer = int(min(table.detected.sum(), (~table.detected).sum()))
    if not 2 <= folds <= rarer:
        raise PemError(f"folds is {folds}, allowed: 2 to {rarer} (obstacles of the rarer outcome)")
    return list(StratifiedKFold(folds).split(table.salient, table.detected))


def _have_outcomes(table: SalientTable, parts: Sequence[tuple[IntArray, IntArray]]) -> bool:
    return all(np.unique(table.detected[part]).size > 1 for both in parts for part in both)


def _lacking_outcome(table: SalientTable, sequence: IntArray, *, folds: int) -> str:
    """What helps where a fold of sequences has one outcome alone."""
    from sklearn.model_selection import GroupKFold  # noqa: PLC0415  slow to import

    rarer = table.detected.mean() < 0.5
    word = "detections" if rarer else "misses"
    rows = table.detected == rarer
    holding = int(np.unique(sequence[rows]).size)
    about = f"folds is {folds}: a fold of sequences lacks an outcome"
    fewer = (
        fewer
        for fewer in range(folds - 1, 1, -1)
        if _have_outcomes(table, list(GroupKFold(fewer).split(table.salient, groups=sequence)))
    )
    if (works := next(fewer, None)) is not None:
        return f"{about}; give {works}"
    return (
        f"{about}, and no number of folds helps: {holding} of {np.unique(sequence).size} sequences "
        f"hold all {np.count_nonzero(rows)} {word}; collect more sequences with {word}, or fit "
        "without scores and without memory (--folds 0)"
    )


def cross_validate(
    table: SalientTable,
    *,
    model: ModelKind,
    folds: int = 5,
    seed: int = 0,
    workers: int = 1,
    on_progress: Callable[[int, int], None] | None = None,
) -> ModelEvaluation:
    """Fit the model on each fold's complement and score it on the fold.

    Fold k uses seed + k. So many workers fit folds at once, each in a process of its own if above
    1; the result is the same. ``on_progress`` is called with folds done and folds in all.

    Raises:
        PemError: fewer obstacles of one outcome than folds.
        RunError: a process died.
    """
    splits = split_folds(table, folds=folds)
    tasks = [
        _Fold(table, train, held_out, model, seed + index)
        for index, (train, held_out) in enumerate(splits)
    ]
    done = count(1)

    def tell(index: int) -> None:  # noqa: ARG001
        if on_progress is not None:
            on_progress(next(done), folds)

    logit = np.empty(len(table))
    scores: list[Scores] = []
    fit_s = 0.0
    answers = map_in_processes(_Fold.answer, tasks, workers=workers, on_done=tell)
    for (_, held_out), (of_fold, fold_s) in zip(splits, answers, strict=True):
        logit[held_out] = of_fold
        scores.append(score(of_fold, table.detected[held_out]))
        fit_s += fold_s / folds
    bins = reliability(logit, table.detected)
    classes, bands = _groups(table)

    def scores_by(groups: Mapping[str, BoolArray]) -> dict[str, Scores]:
        return {
            name: score(logit[rows], table.detected[rows])
            for name, rows in groups.items()
            if rows.any()
        }

    return ModelEvaluation(
        model=model,
        folds=tuple(scores),
        pooled=score(logit, table.detected),
        calibration_error=calibration_error(bins),
        bins=bins,
        by_class=scores_by(classes),
        by_distance=scores_by(bands),
        fit_s=fit_s,
        logit=logit,
    )


def _groups(table: SalientTable) -> tuple[dict[str, BoolArray], dict[str, BoolArray]]:
    """Rows ``[n]`` of road users by class and by distance; none of features of one's own."""
    if table.features is not None:
        return {}, {}
    class_id, z_m = table.salient[:, COLUMN["class_id"]], table.salient[:, COLUMN["z_m"]]
    band = np.searchsorted(DISTANCE_EDGES_M, z_m, side="right")
    classes = {name: class_id == index for index, name in enumerate(CLASS_NAMES)}
    bands = {band_in_words(index): band == index for index in range(len(DISTANCE_EDGES_M) + 1)}
    return classes, bands


@dataclass(frozen=True, eq=False)
class _Fold:
    """One fold's work, which another process can take."""

    table: SalientTable
    train: IntArray
    held_out: IntArray
    model: ModelKind
    seed: int

    def answer(self) -> tuple[FloatArray, float]:
        """Held-out logits and the time that the fit took [s]."""
        started = perf_counter()
        pem = fit_pem(self.table.take(self.train), model=self.model, seed=self.seed)
        fit_s = perf_counter() - started
        return pem.logit(self.table.salient[self.held_out]), fit_s


def card_scores(evaluation: ModelEvaluation) -> dict[str, float]:
    """What a card tells of a cross-validation."""
    folds = f"{len(evaluation.folds)}-fold"
    return {
        f"bce, {folds}": evaluation.bce[0],
        f"roc_auc, {folds}": evaluation.roc_auc[0],
        f"brier, {folds}": evaluation.pooled.brier,
        f"calibration_error, {folds}": evaluation.calibration_error,
    }


def _mean_and_spread(values: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1))


def write_report(
    evaluations: Sequence[ModelEvaluation], *, table: SalientTable, folder: Path
) -> tuple[Path, ...]:
    """Write evaluation.md, .csv, .json and reliability.png into a folder; gives their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = tuple(folder / f"evaluation.{ending}" for ending in ("md", "csv", "json"))
    page = "\n".join(_lines(evaluations, table=table)) + "\n"
    paths[0].write_text(page, encoding="utf-8")
    with paths[1].open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(summary_row(evaluation) for evaluation in evaluations)
    paths[2].write_text(
        json.dumps(as_json(evaluations, table=table), indent=1, allow_nan=False), encoding="utf-8"
    )
    picture = folder / "reliability.png"
    _write_reliability(evaluations, picture)
    return (*paths, picture)


def summary_row(evaluation: ModelEvaluation) -> dict[str, Any]:
    """One line of the table; None where the paper gives no figure, or features are one's own."""
    values = (
        evaluation.model,
        *evaluation.bce,
        *evaluation.roc_auc,
        evaluation.pooled.brier,
        evaluation.calibration_error,
        evaluation.fit_s,
        *(PAPER_TABLE_1.get(evaluation.model, NO_FIGURES) if evaluation.by_class else NO_FIGURES),
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
                "by_class": {name: asdict(of) for name, of in evaluation.by_class.items()},
                "by_distance": {name: asdict(of) for name, of in evaluation.by_distance.items()},
            }
            for evaluation in evaluations
        ],
    }


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
    models = [evaluation.model for evaluation in evaluations]
    for title, groups in (
        ("class", [evaluation.by_class for evaluation in evaluations]),
        ("distance", [evaluation.by_distance for evaluation in evaluations]),
    ):
        if not any(groups):  # of features of one's own
            continue
        yield ""
        yield f"## By {title}"
        yield ""
        yield f"| {title} | obstacles | missed | " + " | ".join(f"BCE {m}" for m in models) + " |"
        yield "|---" * (3 + len(models)) + "|"
        for name, first in (groups[0] if groups else {}).items():
            scores = " | ".join(f"{group[name].bce:.4f}" for group in groups)
            yield f"| {name} | {first.obstacles} | {first.missed} | {scores} |"
    yield ""
    yield "![Reliability diagrams](reliability.png)"


def _write_reliability(evaluations: Sequence[ModelEvaluation], path: Path) -> None:
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
