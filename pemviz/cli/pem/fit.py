"""``pemviz pem fit``."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.bars import progress_bar
from pemviz.cli.help import HelpPage
from pemviz.cli.pem.checks import (
    check_out,
    check_rate_hz,
    check_seed,
    feature_names,
    tell_doubts,
)
from pemviz.cli.pem.evaluate import QUICK_MODELS
from pemviz.cli.pem.memory import (
    cross_fitted,
    fitted_out_of_fold,
    judged,
    memory_beside,
    memory_in_words,
    write_memory_page,
)
from pemviz.cli.pem.position_errors import write_position_errors
from pemviz.errors import PemError
from pemviz.files.text_files import writing
from pemviz.pem.data.position_errors import load_error_table
from pemviz.pem.data.table import SalientTable, load_table, load_tracks
from pemviz.pem.fitting.fit import ModelKind, Provenance, fit_ensemble, fit_pem
from pemviz.pem.fitting.position_errors import TailChoice
from pemviz.pem.model_files import ENSEMBLE_ENDING, SUFFIX, StoredPem, save_pem
from pemviz.pem.models.cards import UNKNOWN_LICENCE, card_markdown
from pemviz.pem.models.predictive_check import verdict_lines
from pemviz.pem.models.varying_frailty import VaryingFrailty
from pemviz.processes import usable_cpus

PAGE = HelpPage(
    text="""
usage: pemviz pem fit --table FILE --out FILE.safetensors [OPTIONS]
An error model of your detector, and a card that says what it rests on.

Data
  --table FILE           of 'pemviz pem collect', or a table of your own
  --rate-hz 10           frames a second, where the table does not tell
  --features a,b,c       columns of any table that P(missed) depends on: for a
                         simulator of your own
Model
  --model NAME           guess-mu, lr, ml-nn, b-nn as in the paper; gb-paper,
                         gb-raw: boosted trees; best: of gb-raw and lr
  --memory               also how misses follow each other (needs tracks);
                         --varying-frailty: by a second law beside it
  --position-errors      how far off it says a car is, not misses; --tails
  --members 20           also refits of it, beside it; not with --memory
  --folds N, --seed N    of the cross-validation; of everything random
Card
  --name TEXT, --data TEXT, --licence TEXT    what it is called and rests on
Examples
  pemviz pem fit --table obstacles.csv --members 20 --out my.safetensors
  pemviz pem fit --table tracks.csv --model gb-raw --memory --out my.safetensors
  pemviz pem fit --table tracks.csv --position-errors --out errors.safetensors
More: --help OPTION, such as --help members; --help-all for everything""",
)

CANDIDATES: tuple[ModelKind, ...] = ("gb-raw", "lr")
"""What ``best`` chooses from: what fits any shape, and what cannot remember single tracks."""
ModelChoice = ModelKind | Literal["best"]


@dataclass(frozen=True)
class FitArguments:
    """Train a perception error model; writes OUT.safetensors and its card (.md, .json)."""

    table: Path
    """Training data: a table of 'pemviz pem collect' or one of your own (.csv, .parquet, .arrow,
    .feather), or a folder with salient_inputs.txt and salient_labels.txt."""
    out: Path
    """File to write, ending in .safetensors."""
    model: ModelChoice = "ml-nn"
    """Kind of model: guess-mu, lr, ml-nn and b-nn as in the paper (b-nn needs pyro-ppl);
    gb-paper and gb-raw are boosted trees on the paper's inputs or on all columns; best is gb-raw or
    lr, whichever predicts better what it was not fitted to (the lower bce over the folds)."""
    seed: int = 0
    """Seed of everything random (0 or more)."""
    members: int = 0
    """Also train an ensemble of so many members (0 or at least 2; 20 for a 95 % interval),
    each on a bootstrap sample, into OUT-ensemble.safetensors. Not with memory: fit them first, then
    the memory into the same OUT, beside which they stay."""
    memory: bool = False
    """Also fit the memory of misses (memory time and frailty) to tracks: the table needs the
    columns sequence, frame and track; folds are then of sequences. Tells and writes what 'pemviz
    pem memory' does, into OUT-memory.md and .png, and tells and keeps in the card what 'pemviz pem
    check' does of the same folds."""
    varying_frailty: bool = False
    """With memory: also fit the other law of misses, as 'pemviz pem memory' does, and keep it in
    the card, for runs with memory_law visibility."""
    features: str = ""
    """Columns that P(missed) depends on, between commas, such as distance,lux,rain, in place of a
    road user's salient variables; beside them the table needs detected (0 or 1) alone. A column of
    words is a category, one of codes too as name:category. The model is for a simulator of your own
    that gives these as salient variables, in this order, and names them in salient_names."""
    rate_hz: float | None = None
    """With memory or position errors: frames a second, where the table has no column rate_hz
    (above 0)."""
    position_errors: bool = False
    """Fit errors of reported positions instead of misses, by distance and bearing: the table has
    x_m, z_m, range_error_m and cross_range_error_m (or x_error_m and z_error_m), and perhaps
    alpha_rad, speed_error_mps, sequence, frame, track; or is a folder of nuScenes cars."""
    tails: TailChoice = "auto"
    """With position errors: family of the errors; auto takes the likelier on held-out errors."""
    folds: int = 5
    """Folds of the cross-validation whose scores go into the card (0: none, or at least 2)."""
    name: str | None = None
    """Name of the model; the file's name if not given."""
    data: str | None = None
    """The training data in words, for the card; the table's name if not given."""
    licence: str = UNKNOWN_LICENCE
    """Terms that the training data puts on the model, for the card."""


def run(arguments: FitArguments) -> int:
    """Train, score, write; gives the exit code.

    Raises:
        PemError: bad arguments or table; one line says what, where and what is allowed.
    """
    _validate(arguments)
    if arguments.position_errors:
        return _fit_position_errors(arguments)
    if arguments.memory:
        return _fit_with_memory(arguments)
    table = load_table(arguments.table, features=feature_names(arguments.features))
    name = arguments.name or arguments.out.stem
    provenance = Provenance(data=arguments.data or table.source, licence=arguments.licence)
    model, scores = _scored(table, arguments=arguments)
    with progress_bar(f"fit {model}") as tell:
        pem = fit_pem(
            table,
            model=model,
            seed=arguments.seed,
            name=name,
            provenance=provenance,
            on_progress=tell,
        )
    _write(replace(pem, card=replace(pem.card, scores=scores)), arguments.out)
    if arguments.members:
        with progress_bar(f"fit {arguments.members} members") as tell:
            ensemble = fit_ensemble(
                table,
                model=model,
                members=arguments.members,
                seed=arguments.seed,
                name=f"{name}{ENSEMBLE_ENDING}",
                provenance=provenance,
                on_progress=tell,
            )
        _write(ensemble, arguments.out.with_name(f"{arguments.out.stem}{ENSEMBLE_ENDING}{SUFFIX}"))
    return 0


def _fit_with_memory(arguments: FitArguments) -> int:
    # scikit-learn and scipy take seconds to import
    from pemviz.pem.judging.cross_validation import score  # noqa: PLC0415
    from pemviz.pem.judging.memory_report import CrossFitted, with_memory  # noqa: PLC0415
    from pemviz.pem.judging.predictive_check import check_held_out  # noqa: PLC0415

    tracks = load_tracks(
        arguments.table, rate_hz=arguments.rate_hz, features=feature_names(arguments.features)
    )
    tell_doubts(tracks.doubts)
    source = tracks.obstacles.source
    provenance = Provenance(data=arguments.data or source, licence=arguments.licence)
    name = arguments.name or arguments.out.stem
    fits: dict[ModelKind, CrossFitted] = {
        kind: cross_fitted(
            tracks,
            model=kind,
            folds=arguments.folds,
            seed=arguments.seed,
            whole=partial(
                fit_pem, model=kind, seed=arguments.seed, name=name, provenance=provenance
            ),
        )
        for kind in _compared(arguments.model)
    }
    bce: dict[ModelKind, float] = {
        kind: score(fit.logit, tracks.detected).bce for kind, fit in fits.items()
    }
    held_out = fits[_chosen(arguments.model, bce)]
    report = memory_beside(tracks, held_out, seed=arguments.seed, varying=arguments.varying_frailty)
    assert held_out.whole is not None  # noqa: S101  asked for above
    visibilities: tuple[VaryingFrailty, ...] = ()
    if report.varying is not None:
        visibilities = fitted_out_of_fold(tracks, held_out, start=report.varying.law)
    with progress_bar("predictive checks") as tell:
        checked = check_held_out(
            tracks, held_out, report.surface, visibilities=visibilities,
            seed=arguments.seed, on_progress=tell,
        )  # fmt: skip
    pem = with_memory(
        held_out.whole, tracks, cross_fitted=held_out, report=report, check=checked.check
    )
    _write(pem, arguments.out)
    check = judged(tracks, held_out, report)
    page = arguments.out.with_name(f"{arguments.out.stem}-memory.md")
    write_memory_page(report, check, page, title=source)
    print(memory_in_words(report, check))
    print("\n".join(verdict_lines(checked.check)))
    return 0


def _fit_position_errors(arguments: FitArguments) -> int:
    table = load_error_table(arguments.table, rate_hz=arguments.rate_hz)
    # scipy's optimisers take a second to import
    from pemviz.pem.judging.position_error_report import FitSettings, fit_position_errors  # noqa: PLC0415

    settings = FitSettings(
        name=arguments.name or arguments.out.stem,
        data=arguments.data or table.source,
        licence=arguments.licence,
        tails=arguments.tails,
        seed=arguments.seed,
    )
    with progress_bar("position errors") as tell:
        model = fit_position_errors(table, settings, on_progress=tell)
    write_position_errors(model, arguments.out)
    return 0


def _validate(arguments: FitArguments) -> None:
    check_out(arguments.out, ending=SUFFIX)
    check_seed(arguments.seed)
    if arguments.members < 0 or arguments.members == 1:
        raise PemError(f"members is {arguments.members}, allowed: 0, or 2 or more")
    if arguments.members and arguments.model == "b-nn":
        raise PemError("members: model 'b-nn' is an ensemble of posterior draws by itself")
    if arguments.memory and arguments.members:
        raise PemError("members: not with memory; fit them first, then memory into the same out")
    if arguments.position_errors and (arguments.memory or arguments.members):
        raise PemError("position_errors: not with memory or members; fit these in another run")
    if arguments.features and arguments.position_errors:
        raise PemError("features: not with position errors, which depend on distance and bearing")
    if arguments.tails != "auto" and not arguments.position_errors:
        raise PemError("tails: only with position errors")
    if arguments.varying_frailty and not arguments.memory:
        raise PemError("varying_frailty: only with memory, beside which it is fitted")
    if arguments.memory and arguments.folds < 2:
        raise PemError(f"folds is {arguments.folds}, allowed with memory: 2 or more")
    if arguments.model == "best" and arguments.folds < 2:
        raise PemError(f"folds is {arguments.folds}, allowed with model best: 2 or more")
    check_rate_hz(arguments.rate_hz)
    if arguments.folds < 0 or arguments.folds == 1:
        raise PemError(f"folds is {arguments.folds}, allowed: 0, or 2 or more")


def _compared(choice: ModelChoice) -> tuple[ModelKind, ...]:
    """Kinds that are fitted to folds: with the chosen one that which it must not fall behind."""
    if choice == "best":
        return CANDIDATES
    return (choice,) if choice in QUICK_MODELS else (choice, "lr")


def _chosen(choice: ModelChoice, bce: Mapping[ModelKind, float]) -> ModelKind:
    """The kind to fit, by the cross-entropies [nats] of held-out rows, with what they say."""
    least = min(bce, key=lambda kind: bce[kind])
    if choice == "best":
        each = ", ".join(f"{kind} {value:.4f}" for kind, value in bce.items())
        print(f"bce of rows that were not fitted: {each}; {least} is fitted")
        return least
    if least != choice:
        tell_doubts([
            f"{least} predicts rows that it was not fitted to better than {choice} (bce "
            f"{bce[least]:.4f} and {bce[choice]:.4f}): {choice} takes single obstacles for a rule, "
            f"and near or rare states may be far off; fit --model {least}, or best"
        ])  # fmt: skip
    return choice


def _scored(table: SalientTable, *, arguments: FitArguments) -> tuple[ModelKind, dict[str, float]]:
    """The kind to fit and its scores over folds, none without folds."""
    if arguments.folds == 0:
        assert arguments.model != "best"  # noqa: S101  refused before
        return arguments.model, {}
    # scikit-learn takes seconds to import
    from pemviz.pem.judging.cross_validation import (  # noqa: PLC0415
        ModelEvaluation,
        card_scores,
        cross_validate,
    )

    evaluations: dict[ModelKind, ModelEvaluation] = {}
    for kind in _compared(arguments.model):
        with progress_bar(f"{kind}: {arguments.folds}-fold cross-validation") as tell:
            evaluations[kind] = cross_validate(
                table,
                model=kind,
                folds=arguments.folds,
                seed=arguments.seed,
                workers=1 if kind in QUICK_MODELS else usable_cpus(),
                on_progress=tell,
            )
    model = _chosen(arguments.model, {kind: one.bce[0] for kind, one in evaluations.items()})
    return model, card_scores(evaluations[model])


def _write(pem: StoredPem, path: Path) -> None:
    card = {key: value for key, value in asdict(pem.card).items() if key != "support"}
    metadata = {**card, "digest": pem.digest, **pem.options(), **_normalisation(pem.tensors())}
    text = json.dumps(metadata, indent=1, allow_nan=False)
    page = card_markdown(pem.card, digest=pem.digest)
    with writing(path):
        save_pem(pem, path)
        path.with_suffix(".md").write_text(page, encoding="utf-8")
        path.with_suffix(".json").write_text(text, encoding="utf-8")
    scores = ", ".join(f"{name} {value:.4f}" for name, value in pem.card.scores.items())
    print(f"{path}: {pem.card.model}, SHA-256 {pem.digest[:16]}{', ' if scores else ''}{scores}")


def _normalisation(tensors: dict[str, AnyArray]) -> dict[str, Any]:
    """Mean and deviation of the numeric inputs, where a model has them."""
    named = {"pose.mean": "normalisation_mean", "pose.std": "normalisation_std"}
    return {
        words: np.asarray(tensors[name]).tolist()
        for name, words in named.items()
        if name in tensors
    }
