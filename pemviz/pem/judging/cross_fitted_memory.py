"""An error model and its memory of misses from the same video."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.pem.data.tracks import TrackTable
from pemviz.pem.fitting.fit import ModelKind, Provenance, fit_pem
from pemviz.pem.fitting.memory import fit_memory
from pemviz.pem.judging.memory_report import MemoryReport, memory_table, report_memory
from pemviz.pem.judging.scores import score
from pemviz.pem.models.ensemble import EnsemblePem, SingleModel
from pemviz.pem.models.memory_card import FLATTERY_IF

Progress = Callable[[int, int], None]
FOLDS = 5


@dataclass(frozen=True)
class CrossFitted:
    """What models that saw none of an observation's own sequence say of it.

    Attributes:
        logit: Of P(detected | state), ``[n]``.
        folds: How many parts the sequences were put into.
    """

    logit: FloatArray
    folds: int


def cross_fit(
    tracks: TrackTable,
    *,
    model: ModelKind,
    folds: int = FOLDS,
    seed: int = 0,
    on_progress: Progress | None = None,
) -> CrossFitted:
    """Fit a model to all but a part of the sequences, and ask it about that part.

    Args:
        tracks: n observations.
        model: Kind of the model.
        folds: Parts of the sequences; at most as many as there are sequences.
        seed: Of the fits.
        on_progress: Told (folds done, folds in all).

    Raises:
        PemError: There are fewer sequences than folds, or a part lacks an outcome.
    """
    from sklearn.model_selection import GroupKFold  # noqa: PLC0415  slow to import

    count = int(np.unique(tracks.sequence).size)
    if not 2 <= folds <= count:
        raise PemError(f"folds is {folds}, allowed: 2 to the number of sequences, {count}")
    logit = np.empty(len(tracks))
    parts = GroupKFold(folds).split(logit, groups=tracks.sequence)
    for done, (train, held_out) in enumerate(parts, start=1):
        pem = fit_pem(tracks.obstacles.take(train), model=model, seed=seed)
        logit[held_out] = pem.logit(tracks.obstacles.salient[held_out])
        if on_progress is not None:
            on_progress(done, folds)
    return CrossFitted(logit=logit, folds=folds)


def fit_report(
    tracks: TrackTable, cross_fitted: CrossFitted, *, seed: int = 0,
    on_progress: Progress | None = None,
) -> MemoryReport:  # fmt: skip
    """The memory of tracks and how well it tells them; see :func:`fit_memory`.

    Args:
        tracks: n observations.
        cross_fitted: What P(missed | state) is by models that did not see them.
        seed: Of the simulation.
        on_progress: Told (tracks done, tracks in all).

    Raises:
        PemError: There is nothing to fit a memory to.
    """
    fit = fit_memory(tracks, cross_fitted.logit, on_progress=on_progress)
    return report_memory(tracks, cross_fitted.logit, fit=fit, seed=seed)


def fit_tracked_pem(
    tracks: TrackTable,
    *,
    model: ModelKind,
    name: str,
    provenance: Provenance,
    cross_fitted: CrossFitted,
    report: MemoryReport,
    flattery: str = FLATTERY_IF,
    seed: int = 0,
) -> SingleModel | EnsemblePem:
    """A model of all tracks whose card holds their memory and scores by held-out sequences.

    Args:
        tracks: n observations.
        model: Kind of the model.
        name: Of the model.
        provenance: For the card.
        cross_fitted: Held-out logits, of which the scores are.
        report: The memory.
        flattery: What the training of the detector does to its figures, for the card.
        seed: Of the fit.

    Raises:
        PemError: The table cannot be fitted.
    """
    pem = fit_pem(tracks.obstacles, model=model, seed=seed, name=name, provenance=provenance)
    words = f"{cross_fitted.folds} folds of sequences"
    held_out = score(cross_fitted.logit, tracks.detected)
    scores = {f"bce, {words}": held_out.bce, f"brier, {words}": held_out.brier}
    if held_out.roc_auc is not None:
        scores[f"roc_auc, {words}"] = held_out.roc_auc
    card = replace(pem.card, scores=scores, memory=memory_table(report, flattery=flattery))
    return replace(pem, card=card)
