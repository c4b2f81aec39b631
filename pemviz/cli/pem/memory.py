"""``pemviz pem memory``: how misses follow each other on video, and whether independence holds."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pemviz.bars import progress_bar
from pemviz.cli.pem.checks import (
    check_out,
    check_rate_hz,
    check_seed,
    feature_names,
    tell_doubts,
)
from pemviz.cli.pem.evaluate import QUICK_MODELS
from pemviz.files.text_files import writing
from pemviz.pem.data.table import TrackTable, load_tracks
from pemviz.pem.fitting.fit import ModelKind
from pemviz.pem.judging.independence import MOST_SEQUENCES, IndependenceCheck, NeededSample
from pemviz.pem.judging.memory_report import (
    MemoryReport,
    memory_line,
    memory_table,
    write_memory_picture,
)
from pemviz.pem.models.cards import memory_markdown
from pemviz.processes import usable_cpus

if TYPE_CHECKING:
    from pemviz.pem.judging.memory_report import CrossFitted, Fit
    from pemviz.pem.models.varying_frailty import VaryingFrailty

SMALL_P = 1e-4
STATELESS: ModelKind = "guess-mu"


@dataclass(frozen=True)
class MemoryArguments:
    """Fit the memory of misses to tracks, and judge whether they could be independent."""

    table: Path
    """Tracks: a CSV with sequence, frame, track, the salient columns and detected (0 or 1); with
    the model guess-mu the salient columns may be missing."""
    model: ModelKind = "gb-raw"
    """Kind of model that gives P(missed | state); guess-mu knows no state, so that all the state
    would explain passes for memory."""
    folds: int = 5
    """Parts of the sequences; a part's P(missed) comes from the others (2 or more)."""
    rate_hz: float | None = None
    """Frames a second, where the table has no column rate_hz (above 0)."""
    seed: int = 0
    """Seed of fits and simulation (0 or more)."""
    out: Path | None = None
    """Page of markdown to write (.md), and a picture of the same name (.png); none if not given."""
    features: str = ""
    """Columns that P(missed) depends on, between commas, in place of the salient ones; as of
    'pemviz pem fit'."""
    varying_frailty: bool = False
    """Also fit the other law of misses, by which not outcomes hang together but the obstacle's
    visibility, of which a part comes and goes, and say which is likelier; a minute and more."""
    json: bool = False
    """Print the results as one JSON object instead of text."""


def run(arguments: MemoryArguments) -> int:
    """Fit, judge, tell; gives the exit code.

    Raises:
        PemError: bad arguments or table; one line says what, where and what is allowed.
    """
    check_seed(arguments.seed)
    check_rate_hz(arguments.rate_hz)
    check_out(arguments.out, ending=".md")
    tracks = load_tracks(
        arguments.table,
        rate_hz=arguments.rate_hz,
        needs_state=arguments.model != STATELESS,
        features=feature_names(arguments.features),
    )
    tell_doubts(tracks.doubts)
    held_out = cross_fitted(
        tracks, model=arguments.model, folds=arguments.folds, seed=arguments.seed
    )
    report = memory_beside(tracks, held_out, seed=arguments.seed, varying=arguments.varying_frailty)
    check = judged(tracks, held_out, report)
    if arguments.out is not None:
        write_memory_page(report, check, arguments.out, title=tracks.obstacles.source)
    if arguments.json:
        document = {"memory": memory_table(report), "independence": asdict(check)}
        print(json.dumps(document, allow_nan=False))
        return 0
    print(memory_in_words(report, check))
    return 0


def cross_fitted(
    tracks: TrackTable, *, model: ModelKind, folds: int, seed: int, whole: "Fit | None" = None
) -> "CrossFitted":
    """Cross-fitted P(missed) of tracks, with progress.

    ``whole`` fits the model of all tracks at the same time.
    """
    from pemviz.pem.judging.memory_report import cross_fit  # noqa: PLC0415  scikit-learn

    with progress_bar("folds of sequences") as tell:
        return cross_fit(
            tracks,
            model=model,
            folds=folds,
            seed=seed,
            whole=whole,
            workers=1 if model in QUICK_MODELS else usable_cpus(),
            on_progress=tell,
        )


def memory_beside(
    tracks: TrackTable, held_out: "CrossFitted", *, seed: int, varying: bool = False
) -> MemoryReport:
    """The memory of misses beside cross-fitted P(missed), with progress.

    With ``varying`` the law of a time-varying frailty too.
    """
    # scipy's distributions take seconds to import
    from pemviz.pem.fitting.varying_frailty import fit_varying_frailty  # noqa: PLC0415
    from pemviz.pem.judging.memory_report import fit_report  # noqa: PLC0415

    with progress_bar("memory of misses") as tell:
        report = fit_report(tracks, held_out, seed=seed, on_progress=tell)
    if not varying:
        return report
    memory = report.fit.memory
    with progress_bar("time-varying frailty") as tell:
        fit = fit_varying_frailty(tracks, held_out.logit, memory=memory, on_progress=tell)
    return replace(report, varying=fit)


def fitted_out_of_fold(
    tracks: TrackTable, held_out: "CrossFitted", *, start: "VaryingFrailty"
) -> "tuple[VaryingFrailty, ...]":
    """The time-varying frailty of each part of the sequences, with progress.

    The search begins at ``start``, the law of all.
    """
    from pemviz.pem.fitting.varying_frailty import held_out_laws  # noqa: PLC0415  scipy is slow

    with progress_bar("time-varying frailty, parts") as tell:
        return held_out_laws(
            tracks, held_out.logit, part=held_out.part, start=start, on_progress=tell
        )


def judged(tracks: TrackTable, held_out: "CrossFitted", report: MemoryReport) -> IndependenceCheck:
    """Whether the misses could be independent."""
    from pemviz.pem.judging.independence import check_independence  # noqa: PLC0415  scipy is slow

    return check_independence(tracks, held_out.logit, fit=report.fit)


def write_memory_page(
    report: MemoryReport, check: IndependenceCheck, path: Path, *, title: str
) -> None:
    """Write a page of markdown and, with the same name, a picture (.png).

    Raises:
        PemError: They cannot be written.
    """
    table = memory_table(report)
    with writing(path):
        path.write_text(f"{memory_markdown(table)}\n{_verdict(check)}\n", encoding="utf-8")
        write_memory_picture(table, path.with_suffix(".png"), title=title)


def memory_in_words(report: MemoryReport, check: IndependenceCheck) -> str:
    """What is printed of a memory: its figures, and whether the misses could be independent."""
    return f"{memory_line(report)}\n{_verdict(check)}"


def _verdict(check: IndependenceCheck) -> str:
    seen = (
        f"{check.misses_after_miss} misses right after a miss, where independence expects "
        f"{check.expected:.1f}"
    )
    needed = "\n".join(f"  {each.tau_s:g} s: {_sample(each)}" for each in check.needed)
    low, high = check.tau_interval_s
    p_value = "below 0.0001" if check.p_value < SMALL_P else f"{check.p_value:.2g}"
    judged = (
        f"this sample is compatible with independent misses (p-value {p_value}), but refuses only "
        f"memory times above {high:.2g} s"
        if check.compatible
        else f"independent misses do not explain this detector (p-value {p_value}): memory times "
        f"of {low:.2g} to {high:.2g} s do"
    )
    return (
        f"{seen}\n{judged}\nvideo like this that shows a memory time above 0 (at most 5 % false "
        f"alarm, 80 % power):\n{needed}"
    )


def _sample(needed: NeededSample) -> str:
    if needed.sequences >= MOST_SEQUENCES:
        return "no number of sequences"
    return f"{needed.sequences} sequences, {needed.pairs} pairs of observations"
