"""``pemviz assess``: from a detector's files to an answer and a report, in one command.

It only puts commands together: each is printed, and carried out with the very words that are
printed, so that whoever repeats them gets the same numbers.
"""

import contextlib
import io
import json
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from pemviz.cli.help import HelpPage
from pemviz.cli.main import run_command
from pemviz.cli.parsing import parse_arguments
from pemviz.cli.pem.collect import is_of_images
from pemviz.cli.pem.fit import ModelChoice
from pemviz.cli.record_arguments import parse as parse_record
from pemviz.config.rule_words import Bound
from pemviz.errors import EXIT_FAILED, ConfigError, PemError
from pemviz.pem.data.columns import read_columns
from pemviz.pem.data.detections import SequenceFormat
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.recognise import CollectedFormat, Recognised, recognise
from pemviz.pem.data.table import OUTCOME_COLUMN, RATE_COLUMN, TIME_COLUMN

PAGE = HelpPage(
    text="""
usage: pemviz assess --labels PATH --detections PATH [OPTIONS]
From your detector's files to how likely it lets the car crash: prints each
command that this stands for, and writes a report.

Files, whose format is found out
  --labels PATH          what was there: labels of KITTI, nuScenes, Argoverse,
                         MOTChallenge, COCO, FiftyOne; rosbags (--labels-topic)
  --detections PATH      what the detector reported on the same frames
  --format NAME          where it is to be another; of a log --mapping FILE.toml
  --rate-hz 10           frames a second of sequences
What counts
  --types Car            classes that are obstacles
  --iou-above 0.5        overlap that makes a detection; --score-from X
Question
  --preset NAME          the scenario, as of 'pemviz record' [paper]
  --target P             the probability that is to be claimed; --fail-above P
Output
  --out DIR              table, models, pictures, runs, report.html [assessment]
Examples
  pemviz assess --labels label_02 --detections boxes
  pemviz assess --labels v1.0-mini --detections found.json --preset cut-in
  pemviz assess --labels MOT17/train --detections MOT17/train --target 1e-6
More: --help OPTION, such as --help types; --help-all for everything""",
)
OWN = "detector.safetensors"
FOLDS = 5
LARGE_OVERLAP = 0.5
PLACES = (*("labels_topic", "detections_topic", "ego_topic", "labels_field", "detections_field"),)
"""Options that say where in a file labels and detections are."""
STAND_IN = "ml-nn"
"""Says how likely a miss is where the files know no places."""


@dataclass(frozen=True, kw_only=True)
class AssessArguments:
    """Options of ``pemviz assess``."""

    labels: Path
    """What was there: a folder of KITTI label files (label_2) or tracking labels (label_02), of
    nuScenes' tables (v1.0-mini), of MOTChallenge's sequences or of Argoverse 2's annotations;
    COCO's ground truth, FiftyOne's samples.json, rosbags; or a log's file, or the folder of
    published obstacles (salient_inputs.txt)."""
    detections: Path
    """What the detector reported on the same frames: a folder or a json file, as of 'pemviz pem
    collect'."""
    out: Path = Path("assessment")
    """Folder for tables, models, pictures, runs and report.html; made if need be, files of the same
    name are replaced."""
    format: CollectedFormat | None = None
    """How the detections are written, where it is not to be found out from the files."""
    mapping: Path | None = None
    """TOML that says where the columns of a log are, as of 'pemviz pem collect'."""
    labels_topic: str = ""
    """With rosbags: the topic of reference boxes."""
    detections_topic: str = ""
    """With rosbags: the topic of what the detector reported."""
    ego_topic: str = ""
    """With rosbags whose boxes are in a fixed frame: where the ego is."""
    labels_field: str = ""
    """With a data set of FiftyOne's: the field of labels."""
    detections_field: str = ""
    """With a data set of FiftyOne's: the field of what the detector reported."""
    rate_hz: float | None = None
    """Frames a second of sequences (above 0), where the files do not tell; left out, 10 are
    assumed, and said to be."""
    types: tuple[str, ...] = ()
    """Classes that count as obstacles in sequences; left out, cars, but in MOTChallenge's files and
    in images all."""
    iou_above: float = LARGE_OVERLAP
    """A pair of boxes counts as a detection above this overlap (0 to below 1)."""
    score_from: float | None = None
    """Ignore detections with a lower score, on the detector's own scale (any number)."""
    image_sizes: Path | None = None
    """CSV with the columns frame, width_px, height_px; YOLO text needs it."""
    missing_is_empty: bool = False
    """Take a frame without detections file as one in which nothing was detected."""
    model: ModelChoice = "best"
    """Kind of error model, as of 'pemviz pem fit'; best is boosted trees (gb-raw) or logistic
    regression (lr), whichever predicts better what it was not fitted to. Files that know no places
    take the shipped ml-nn."""
    no_position_errors: bool = False
    """Leave out errors of reported positions, where the files have them."""
    preset: str = "paper"
    """The scenario and its rules, as of 'pemviz record'."""
    target: float | None = None
    """Failure probability to claim: the report judges the claim, and what to measure next aims at
    it; above 0, at most 1."""
    fail_above: tuple[str, ...] = ()
    """Exit with code 1 if the upper 95 % bound is above this probability; NAME=P for one of several
    rules."""
    fail_on: Bound = "sampling"
    """Which upper bound --fail-above judges, as of 'pemviz record'."""
    seed: int = 0
    """Root of all randomness; 0 or more."""


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code, which is that of ``pemviz record``.

    Raises:
        InputError: The files or an option cannot be used.
        RunError: The run failed.
    """
    arguments = parse_arguments(AssessArguments, words, command="assess", page=PAGE)
    files = _files(arguments)
    parse_record(_record_words(arguments, "--pem", STAND_IN))  # before minutes of fitting
    _make_folder(arguments.out)
    print(f"{files.labels}, {files.detections}: {files.words} (format {files.file_format})")
    return _Assessment(arguments, files).carry_out()


def _files(arguments: AssessArguments) -> Recognised:
    """What the files are, by themselves or as the options say."""
    labels, detections, mapping = arguments.labels, arguments.detections, arguments.mapping
    if arguments.format is not None or mapping is not None:
        chosen = arguments.format or "log"
        if (chosen == "log") != (mapping is not None):
            raise ConfigError("mapping: must be given with format log, and with no other")
        return Recognised(chosen, labels, detections, "as you say", mapping)
    found = recognise(labels, detections)
    if found.file_format == "log" and found.mapping is None:
        raise PemError(
            f"labels = {labels}: rows of a log; --mapping FILE.toml must say where their columns "
            "are (other labels are folders)"
        )
    return found


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"out = {out}: no folder can be made there ({error.strerror or error})"
        ) from error


def _record_words(arguments: AssessArguments, *own: str) -> list[str]:
    words = ["--preset", arguments.preset, *own, "--memory-curve", "--seed", str(arguments.seed)]
    if arguments.target is not None:
        words += ["--target", f"{arguments.target:g}"]
    for limit in arguments.fail_above:
        words += ["--fail-above", limit]
    words += ["--fail-on", arguments.fail_on] if arguments.fail_on != "sampling" else []
    return [*words, "--out", str(arguments.out / "runs")]


@dataclass(frozen=True)
class _Collected:
    """What a table holds.

    Attributes:
        sequences: In how many its obstacles are followed; 0: they are not.
        has_errors: Whether it says how far off positions were.
    """

    path: Path
    has_places: bool
    sequences: int
    has_errors: bool


class _Assessment:
    """The commands of an assessment, one after the other."""

    def __init__(self, arguments: AssessArguments, files: Recognised) -> None:
        self.arguments = arguments
        self.files = files
        self.seconds: dict[str, float] = {}

    def carry_out(self) -> int:
        """Carry all out; gives the exit code."""
        table = self._collect()
        own = [*self._fit(table), *self._fit_position_errors(table)]
        before = self._runs()
        code = self._command("record", *_record_words(self.arguments, *own))
        if code == EXIT_FAILED:
            return code
        (folder,) = self._runs() - before
        page = self.arguments.out / "report.html"
        target = self.arguments.target
        claim = [] if target is None else ["--claim-below", f"{target:g}"]
        self._command("report", str(folder), *claim, "--out", str(page))
        parts = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in self.seconds.items())
        print(f"all in {self.arguments.out}; took {sum(self.seconds.values()):.0f} s: {parts}")
        return code

    def _command(self, *words: str) -> int:
        """Print a command and carry it out; gives its exit code.

        Raises:
            InputError: As the command does.
        """
        print(f"\n$ pemviz {shlex.join(words)}", flush=True)
        began = time.perf_counter()
        code = run_command(words[0], words[1:])
        name = " ".join(words[:2] if words[0] == "pem" else words[:1])
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began
        return code

    def _collect(self) -> _Collected:
        arguments, files = self.arguments, self.files
        if files.file_format == "table":
            return _Collected(files.labels, has_places=True, sequences=0, has_errors=False)
        out = arguments.out / "observations.csv"
        words = ["--labels", str(files.labels), "--detections", str(files.detections)]
        words += ["--format", files.file_format, "--out", str(out)]
        of_images = is_of_images(files.file_format, files.labels)
        is_timed = files.file_format in ("rosbag", "argoverse")
        is_sequence = of_images or files.file_format in (*get_args(SequenceFormat), "motchallenge")
        words += self._places_of_boxes()
        if files.mapping is not None:
            words += ["--mapping", str(files.mapping)]
        if is_sequence and arguments.rate_hz is not None:
            words += ["--rate-hz", f"{arguments.rate_hz:g}"]
        if is_sequence or is_timed or files.file_format == "nuscenes":
            words += ["--types", *self._types()] if self._types() else []
        if files.file_format not in ("nuscenes", "log", "argoverse"):
            words += ["--iou-above", f"{arguments.iou_above:g}"]
        if files.file_format != "motchallenge" and not of_images and not is_timed:
            words.append("--drop-unknown")
        if arguments.score_from is not None:
            words.append(f"--score-from={arguments.score_from:g}")
        if arguments.image_sizes is not None:
            words += ["--image-sizes", str(arguments.image_sizes)]
        words += ["--missing-is-empty"] * arguments.missing_is_empty
        self._command("pem", "collect", *words)
        return self._looked_at(out)

    def _places_of_boxes(self) -> list[str]:
        """Options that say where in the files labels and detections are."""
        named = {name: getattr(self.arguments, name) for name in PLACES}
        return [word for name, value in named.items() if value
                for word in (f"--{name.replace('_', '-')}", value)]  # fmt: skip

    def _types(self) -> tuple[str, ...]:
        files = self.files  # in images and MOTChallenge's files classes have names of their own
        is_any = files.file_format in ("motchallenge", "fiftyone") or files.labels.suffix == ".json"
        return self.arguments.types or (() if is_any else ("Car",))

    def _looked_at(self, path: Path) -> _Collected:
        """What was collected, if it is anything.

        Raises:
            PemError: No obstacle is of the classes, or all or none were detected.
        """
        table = read_columns(path)
        kinds = " ".join(self._types())
        if not len(table):
            raise PemError(f"labels = {self.files.labels}: no obstacle of {kinds or 'any class'}")
        detected = table.numbers(OUTCOME_COLUMN)
        if detected.min() == detected.max():
            what = "detected" if detected.all() else "missed"
            raise PemError(
                f"detections = {self.files.detections}: of {len(detected)} obstacles all are "
                f"{what}: nothing to learn from; do frames and units belong together?"
            )
        moments = ({"frame", RATE_COLUMN}, {TIME_COLUMN})
        has_tracks = {"sequence", "track"} <= set(table.header) and any(
            names <= set(table.header) for names in moments
        )
        return _Collected(
            path,
            has_places="x_m" in table.header,
            sequences=len(set(table.texts("sequence"))) if has_tracks else 0,
            has_errors=PLANE_COLUMNS[0] in table.header,
        )

    def _fit(self, table: _Collected) -> list[str]:
        """Fit error model and memory; gives the options that have a run use them."""
        if not table.has_places:
            return self._fit_memory_alone(table)
        if table.sequences >= 2:
            folds = min(FOLDS, table.sequences)
            self._fit_kind(table, self.arguments.model, "--memory", folds=folds)
        else:
            _note("misses over time: unknown, no obstacle is followed through two sequences")
            self._fit_one_by_one(table)
        _note(
            "how far refits of the model differ is left out, as no ensemble is fitted here: "
            "pemviz pem fit --members 20, before the other, shows it"
        )
        return ["--pem", str(self.arguments.out / OWN)]

    def _fit_one_by_one(self, table: _Collected) -> None:
        """Fit the error model where memory cannot be asked for."""
        model = self.arguments.model
        if model != "best":
            self._fit_kind(table, model, folds=0)
        elif table.sequences:
            _note("lr is fitted: no other sequence tells whether gb-raw remembers single cars")
            self._fit_kind(table, "lr", folds=0)
        else:
            try:
                self._fit_kind(table, model, folds=FOLDS)
            except PemError as error:  # too few misses to part
                _note(f"lr is fitted, gb-raw cannot be judged: {error}")
                self._fit_kind(table, "lr", folds=0)

    def _fit_kind(self, table: _Collected, model: ModelChoice, *words: str, folds: int) -> None:
        given = ["--table", str(table.path), "--model", model, *words, "--folds", str(folds)]
        seeded = ["--seed", str(self.arguments.seed)]
        self._command("pem", "fit", *given, *seeded, "--out", str(self.arguments.out / OWN))

    def _fit_memory_alone(self, table: _Collected) -> list[str]:
        """Where files know no places: a shipped model's misses, with the memory of this detector's.

        Raises:
            PemError: The table has a sequence alone.
        """
        if table.sequences < 2:
            raise PemError(
                f"labels = {self.files.labels}: without places obstacles must be followed "
                "(tracks), in two sequences at least"
            )
        words = ["--table", str(table.path), "--model", "guess-mu"]
        words += ["--folds", str(min(FOLDS, table.sequences)), "--seed", str(self.arguments.seed)]
        words += ["--out", str(self.arguments.out / "memory.md")]
        told = io.StringIO()
        with contextlib.redirect_stdout(told):
            self._command("pem", "memory", *words, "--json")
        command, _, document = told.getvalue().lstrip("\n").partition("\n")
        memory = json.loads(document)["memory"]["fit"]["memory"]
        print(f"\n{command}\n{document.strip()}")
        _note(
            f"these files know no places: how likely a miss is stays that of {STAND_IN}; how "
            "misses follow each other is your detector's, with all that places would explain"
        )
        return [
            *("--pem", STAND_IN, "--memory-s", f"{memory['tau_s']:.4g}"),
            *("--frailty", f"{memory['frailty']:.4g}"),
        ]

    def _fit_position_errors(self, table: _Collected) -> list[str]:
        """Fit errors of positions where there are any; gives the options that use them."""
        if self.arguments.no_position_errors or not table.has_errors:
            return []
        out = str(self.arguments.out / "position-errors.safetensors")
        words = ["--position-errors", "--table", str(table.path), "--out", out]
        words += ["--seed", str(self.arguments.seed)]
        try:
            self._command("pem", "fit", *words)
        except PemError as error:  # too few of them; misses can be assessed all the same
            _note(f"errors of positions are left out: {error}")
            return []
        return ["--position-errors", out]

    def _runs(self) -> set[Path]:
        return set((self.arguments.out / "runs").glob("*"))


def _note(text: str) -> None:
    print(f"pemviz: {text}", file=sys.stderr)
