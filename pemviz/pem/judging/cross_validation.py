"""Cross-validated scores of every kind of model: the paper's Table I and beyond."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from time import perf_counter

import numpy as np
from sklearn.model_selection import GroupKFold, StratifiedKFold

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.support import DISTANCE_EDGES_M, band_in_words
from pemviz.pem.data.table import SalientTable
from pemviz.pem.fitting.fit import ModelKind, fit_pem
from pemviz.pem.judging.scores import ReliabilityBin, Scores, calibration_error, reliability, score
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN
from pemviz.processes import map_in_processes

PAPER_TABLE_1: dict[ModelKind, tuple[float, float]] = {
    "guess-mu": (0.260, 0.5),
    "lr": (0.244, 0.688),
    "ml-nn": (0.226, 0.777),
    "b-nn": (0.238, 0.726),
}
"""(binary cross-entropy, ROC-AUC) as printed in the paper's Table I."""


@dataclass(frozen=True, eq=False)
class ModelEvaluation:
    """Scores of one kind of model, each obstacle judged by a fit that had not seen it."""

    model: ModelKind
    """The kind."""
    folds: tuple[Scores, ...]
    """Scores on each held-out part."""
    pooled: Scores
    """Scores over all obstacles."""
    calibration_error: float
    """Expected calibration error over all obstacles, 15 bins of equal mass."""
    bins: tuple[ReliabilityBin, ...]
    """The reliability diagram."""
    by_class: dict[str, Scores]
    """Scores by class."""
    by_distance: dict[str, Scores]
    """Scores by distance band."""
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
    sequence = kept_whole(table)
    if sequence is not None:
        sequences = int(np.unique(sequence).size)
        if not 2 <= folds <= sequences:
            raise PemError(f"folds is {folds}, allowed: 2 to {sequences} (sequences)")
        parts = list(GroupKFold(folds).split(table.salient, groups=sequence))
        if any(np.unique(table.detected[part]).size == 1 for both in parts for part in both):
            raise PemError(f"folds is {folds}: a fold of sequences lacks an outcome; give fewer")
        return parts
    rarer = int(min(table.detected.sum(), (~table.detected).sum()))
    if not 2 <= folds <= rarer:
        raise PemError(f"folds is {folds}, allowed: 2 to {rarer} (obstacles of the rarer outcome)")
    return list(StratifiedKFold(folds).split(table.salient, table.detected))


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

    Args:
        table: obstacles and outcomes.
        model: the kind of model.
        folds: number of folds.
        seed: of the fits; fold k uses seed + k.
        workers: how many folds are fitted at once, each in a process of its own if above 1;
            the result is the same.
        on_progress: told (folds done, folds in all).

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
    return ModelEvaluation(
        model=model,
        folds=tuple(scores),
        pooled=score(logit, table.detected),
        calibration_error=calibration_error(bins),
        bins=bins,
        by_class=_scores_by(_class_names(table), logit, table.detected),
        by_distance=_scores_by(_distance_names(table), logit, table.detected),
        fit_s=fit_s,
        logit=logit,
    )


@dataclass(frozen=True, eq=False)
class _Fold:
    """One fold's work."""

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


def _class_names(table: SalientTable) -> list[tuple[str, BoolArray]]:
    classes = table.salient[:, COLUMN["class_id"]]
    return [(name, classes == index) for index, name in enumerate(CLASS_NAMES)]


def _distance_names(table: SalientTable) -> list[tuple[str, BoolArray]]:
    z_m = table.salient[:, COLUMN["z_m"]]
    band = np.searchsorted(DISTANCE_EDGES_M, z_m, side="right")
    return [(band_in_words(index), band == index) for index in range(len(DISTANCE_EDGES_M) + 1)]


def _scores_by(
    groups: Sequence[tuple[str, BoolArray]], logit: FloatArray, detected: BoolArray
) -> dict[str, Scores]:
    return {name: score(logit[rows], detected[rows]) for name, rows in groups if rows.any()}


def _mean_and_spread(values: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1))
