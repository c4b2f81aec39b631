"""Makes the shipped models with their cards: ``python -m studies.shipped_models.kitti --help``.

Every model is one fit with seed 0, taken as it came: none was chosen for the failure probability
that it leads to.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from pemviz.errors import InputError, PemError
from pemviz.files.shipped import asset_path
from pemviz.pem.data.table import SalientTable, load_table
from pemviz.pem.fitting.fit import KITTI_YOLOV3, ModelKind, fit_ensemble, fit_pem
from pemviz.pem.judging.cross_validation import card_scores, cross_validate
from pemviz.pem.model_files import ASSET_FOLDER, SUFFIX, StoredPem, save_pem
from pemviz.pem.models.cards import card_markdown
from pemviz.pem.models.ensemble import EnsemblePem

MEMBERS = 20
SHIPPED: dict[str, ModelKind] = {
    "lr": "lr",
    "ml-nn": "ml-nn",
    "ml-nn-ensemble": "ml-nn",
    "b-nn": "b-nn",
    "gb-raw": "gb-raw",
}
"""Kind of each shipped model, by name."""


@dataclass(frozen=True)
class ShipArguments:
    """Fit the shipped models again."""

    table: Path
    """Training data: the authors' folder of KITTI obstacles, or a table of 'pem collect'."""
    only: tuple[str, ...] = tuple(SHIPPED)
    """Names of the models to fit."""


def run(arguments: ShipArguments) -> int:
    """Fit, score and write; gives the exit code.

    Raises:
        PemError: a name is none of SHIPPED, or the table cannot be used.
    """
    unknown = set(arguments.only) - set(SHIPPED)
    if unknown:
        raise PemError(f"unknown models {sorted(unknown)}, allowed: {', '.join(SHIPPED)}")
    table = load_table(arguments.table)
    folder = asset_path(ASSET_FOLDER)
    scores: dict[ModelKind, dict[str, float]] = {}
    for name in arguments.only:
        kind = SHIPPED[name]
        print(f"{name}: cross-validation", file=sys.stderr)
        if kind not in scores:
            scores[kind] = card_scores(cross_validate(table, model=kind))
        print(f"{name}: fit", file=sys.stderr)
        pem = _fit(table, name=name, kind=kind)
        pem = _with_scores(pem, scores[kind])
        save_pem(pem, folder / f"{name}{SUFFIX}")
        text = card_markdown(pem.card, digest=pem.digest)
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    return 0


def _fit(table: SalientTable, *, name: str, kind: ModelKind) -> StoredPem:
    if name.endswith("-ensemble"):
        return fit_ensemble(table, model=kind, members=MEMBERS, name=name, provenance=KITTI_YOLOV3)
    return fit_pem(table, model=kind, name=name, provenance=KITTI_YOLOV3)


def _with_scores(pem: StoredPem, scores: dict[str, float]) -> StoredPem:
    if isinstance(pem, EnsemblePem) and pem.card.model != "b-nn":
        scores = {f"single model's {key}": value for key, value in scores.items()}
    return replace(pem, card=replace(pem.card, scores=scores))


def main(run_arguments: Callable[[ShipArguments], int] = run) -> int:
    """Command line; gives the exit code."""
    try:
        return run_arguments(tyro.cli(ShipArguments))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    raise SystemExit(main())
