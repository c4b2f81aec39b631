"""``pemviz pem check``: does an error model give tracks like those that were observed?"""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pemviz.bars import progress_bar
from pemviz.cli.help import HelpPage
from pemviz.cli.pem.checks import (
    check_out,
    check_rate_hz,
    check_seed,
    feature_names,
    tell_doubts,
)
from pemviz.cli.pem.memory import STATELESS, cross_fitted, fitted_out_of_fold
from pemviz.errors import PemError
from pemviz.files.text_files import writing
from pemviz.pem.data.columns import table_header
from pemviz.pem.data.own_columns import named_columns
from pemviz.pem.data.position_errors import AXIS_COLUMNS, PLANE_COLUMNS, load_error_csv
from pemviz.pem.data.table import coded_as, load_table, load_tracks
from pemviz.pem.fitting.fit import ModelKind
from pemviz.pem.model_files import load_pem, load_position_errors
from pemviz.pem.models.cards import PemCard
from pemviz.pem.models.own_features import own_features_of
from pemviz.pem.models.predictive_check import DRAWS, FEWEST_DRAWS, MOST_DRAWS

DEFAULT_KIND: ModelKind = "gb-raw"

if TYPE_CHECKING:
    from pemviz.pem.judging.position_error_check import ErrorLaw
    from pemviz.pem.judging.predictive_check import Checked
    from pemviz.pem.models.varying_frailty import VaryingFrailty

PAGE = HelpPage(
    text="""
usage: pemviz pem check --table tracks.csv [--model NAME | --pem FILE] [OPTIONS]
Does an error model give tracks like those that were observed? How long they are
missed, how often close by, from where on they are seen; independent, with a
memory time, a frailty, both.

What is checked
  --table FILE           tracks of 'pemviz pem collect', or of your own
  --model gb-raw         a kind of model; a part of the sequences is judged by a
                         model of the others (--folds 5)
  --pem FILE             or a fitted model, against tracks that it has not seen
  --position-errors FILE with --pem: also its errors of positions
  --varying-frailty      with --model: also a visibility that comes and goes
  --rate-hz 10           frames a second, where the table does not tell
How
  --draws 999            data sets drawn from each; --seed N
What comes out
  --out check.md         a page, and a picture beside it; --json
Examples
  pemviz pem check --table tracks.csv --model gb-raw --out check.md
  pemviz pem check --table new-drives.csv --pem own.safetensors
  pemviz pem check --table boxes.csv --model guess-mu --json
More: --help OPTION, such as --help draws; --help-all for everything""",
)


@dataclass(frozen=True)
class CheckArguments:
    """Compare tracks with data sets that an error model draws along them."""

    table: Path
    """Tracks: a CSV with sequence, frame, track, the salient columns and detected (0 or 1); with
    the model guess-mu the salient columns may be missing. Errors of positions are checked where it
    has them (x_error_m and z_error_m, or range_error_m and cross_range_error_m)."""
    model: ModelKind | None = None
    """Kind of model, fitted out of fold: each part of the sequences is told by a model, and a
    memory, of the others; gb-raw if neither this nor pem is given."""
    pem: str | None = None
    """A fitted model instead: a file (.safetensors) or a shipped name; with the memory on its
    card, if it has one."""
    features: str = ""
    """With model: columns that P(missed) depends on, between commas, in place of the salient ones,
    as of 'pemviz pem fit'; a fitted model knows its own."""
    position_errors: str | None = None
    """With pem: the model of position errors (a file, or a shipped name) that is checked beside
    it; without, none is."""
    folds: int = 5
    """Parts of the sequences (2 or more); with model."""
    varying_frailty: bool = False
    """With model: also with a visibility that comes and goes, fitted out of fold, as of 'pemviz pem
    fit'; a fitted model that carries one is checked with it. Minutes with 20,000 observations."""
    rate_hz: float | None = None
    """Frames a second, where the table has no column rate_hz (above 0)."""
    draws: int = DRAWS
    """Data sets drawn from each variant (799 to 100000)."""
    seed: int = 0
    """Seed of fits and draws (0 or more)."""
    out: Path | None = None
    """Page of markdown to write (.md), and a picture of the same name (.png); none if not given."""
    json: bool = False
    """Print the results as one JSON object instead of text."""
    allow_python: bool = False
    """Allow a model named module:attribute, which runs that module's code."""


def run(arguments: CheckArguments) -> int:
    """Draw, compare, tell; gives the exit code.

    Raises:
        PemError: Bad arguments or table; one line says what, where and what is allowed.
    """
    _validate(arguments)
    checked = _of_pem(arguments) if arguments.pem is not None else _of_kind(arguments)
    from pemviz.pem.judging.check_picture import write_check_picture  # noqa: PLC0415  scipy
    from pemviz.reports.check_document import check_document  # noqa: PLC0415
    from pemviz.reports.markdown import document_markdown  # noqa: PLC0415
    from pemviz.reports.terminal import print_document  # noqa: PLC0415

    name = arguments.pem or arguments.model or DEFAULT_KIND
    document = check_document(checked.check, model=name, table=arguments.table.stem)
    if arguments.out is not None:
        picture = arguments.out.with_suffix(".png")
        page = f"{document_markdown(document)}\n![{document.title}]({picture.name})\n"
        with writing(arguments.out):
            arguments.out.write_text(page, encoding="utf-8")
            write_check_picture(checked, picture, title=document.title)
    if arguments.json:
        print(json.dumps({"check": asdict(checked.check)}, allow_nan=False))
        return 0
    print_document(document)
    return 0


def _of_kind(arguments: CheckArguments) -> "Checked":
    """A kind of model, each part of the sequences told by the others."""
    from pemviz.pem.fitting.memory import check_fittable, memory_surface  # noqa: PLC0415  scipy
    from pemviz.pem.fitting.varying_frailty import likeliest_law  # noqa: PLC0415
    from pemviz.pem.judging.position_error_check import cross_fitted_law  # noqa: PLC0415
    from pemviz.pem.judging.predictive_check import check_held_out  # noqa: PLC0415

    model = arguments.model or DEFAULT_KIND
    tracks = load_tracks(
        arguments.table,
        rate_hz=arguments.rate_hz,
        needs_state=model != STATELESS,
        features=feature_names(arguments.features),
    )
    tell_doubts(tracks.doubts)
    check_fittable(tracks)
    held_out = cross_fitted(tracks, model=model, folds=arguments.folds, seed=arguments.seed)
    with progress_bar("memory of misses") as tell:
        surface = memory_surface(tracks, held_out.logit, on_progress=tell)
    visibilities: tuple[VaryingFrailty, ...] = ()
    if arguments.varying_frailty:
        with progress_bar("time-varying frailty") as tell:
            law = likeliest_law(tracks, held_out.logit, on_progress=tell)
        visibilities = fitted_out_of_fold(tracks, held_out, start=law)
    errors: ErrorLaw | None = None
    if _has_errors(arguments.table):
        table = load_error_csv(arguments.table, rate_hz=arguments.rate_hz)
        with progress_bar("position errors") as tell:
            errors = cross_fitted_law(table, seed=arguments.seed, on_progress=tell)
    with progress_bar("data sets") as tell:
        return check_held_out(
            tracks, held_out, surface, visibilities=visibilities, errors=errors,
            draws=arguments.draws, seed=arguments.seed, on_progress=tell,
        )  # fmt: skip


def _of_pem(arguments: CheckArguments) -> "Checked":
    """A fitted model against tracks, with what its card knows of its memory."""
    from pemviz.pem.judging.position_error_check import law_of_model  # noqa: PLC0415  scipy
    from pemviz.pem.judging.predictive_check import check_model  # noqa: PLC0415

    assert arguments.pem is not None  # noqa: S101  asked for above
    pem = load_pem(arguments.pem, allow_python=arguments.allow_python)
    errors: ErrorLaw | None = None
    own = own_features_of(pem)
    features = () if own is None else named_columns(own)
    tracks = load_tracks(arguments.table, rate_hz=arguments.rate_hz, features=features)
    fitted_digests = {
        tracks.obstacles.digest,
        load_table(arguments.table, features=features).digest,
    }
    if own is not None:
        tracks = replace(tracks, obstacles=coded_as(tracks.obstacles, own))
    if arguments.position_errors is not None:
        model = load_position_errors(arguments.position_errors)
        errors = law_of_model(load_error_csv(arguments.table, rate_hz=arguments.rate_hz), model)
    tell_doubts(tracks.doubts)
    card: object = getattr(pem, "card", None)
    # rows as they stand, or sorted
    same = isinstance(card, PemCard) and card.data_digest in fitted_digests
    with progress_bar("data sets") as tell:
        return check_model(
            tracks, pem, errors=errors, same_data=same, draws=arguments.draws,
            seed=arguments.seed, on_progress=tell,
        )  # fmt: skip


def _has_errors(table: Path) -> bool:
    header = set(table_header(table))
    along = {name for axis, name in AXIS_COLUMNS.items() if axis != "speed"}
    return bool(header) and (along <= header or set(PLANE_COLUMNS) <= header)


def _validate(arguments: CheckArguments) -> None:
    if arguments.pem is not None and arguments.model is not None:
        raise PemError("model: not with pem, which is fitted already; give one of them")
    if arguments.features and arguments.pem is not None:
        raise PemError("features: not with pem, which knows its own")
    if arguments.varying_frailty and arguments.pem is not None:
        raise PemError("varying_frailty: not with pem, which is checked with what it carries")
    if arguments.position_errors is not None and arguments.pem is None:
        raise PemError("position_errors: only with pem; with model they are fitted out of fold")
    if arguments.folds < 2:
        raise PemError(f"folds is {arguments.folds}, allowed: 2 or more")
    check_seed(arguments.seed)
    if not FEWEST_DRAWS <= arguments.draws <= MOST_DRAWS:
        raise PemError(f"draws is {arguments.draws}, allowed: {FEWEST_DRAWS} to {MOST_DRAWS}")
    check_rate_hz(arguments.rate_hz)
    check_out(arguments.out, ending=".md")
