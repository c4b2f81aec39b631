"""Somebody's own log as the table that models learn from, by a mapping of its columns.

A log has a row for each obstacle at each moment, with what a detector made of it; in one file, or
in two whose rows belong together: text, JSON lines, parquet or Arrow. It is read and written in
batches (:mod:`pemviz.pem.data.log_batches`); where its columns are a mapping says
(:mod:`pemviz.pem.data.log_mapping`).
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import write_atomically
from pemviz.files.text_files import writing
from pemviz.pem.data.collect import CollectedCounts, Progress
from pemviz.pem.data.columns import Columns, numbers_of, text_of
from pemviz.pem.data.log_batches import LogBatch, log_batches
from pemviz.pem.data.log_mapping import (
    ALPHA,
    MOMENTS,
    NAMES,
    ColumnMapping,
    Source,
    read_mapping,
)
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN, RATE_COLUMN, TIME_COLUMN
from pemviz.pem.data.timing import check_rates, clock_words, rates_of
from pemviz.pem.data.units import check_plausible, unit_factor
from pemviz.pem.models.protocol import SALIENT_COLUMNS, check_rows, known_codes

MOST_LISTED = 20
PROGRESS_STEPS = 1000
JUDGED_ROWS = 200_000
"""Rows at the beginning whose units are judged."""
LARGEST_FRAME = 2.0**53
SPECIAL = (",", '"', "\n", "\r")
"""What a name in a table of text cannot hold."""


@dataclass
class LogCounts(CollectedCounts):
    """What was in a log."""

    obstacles: int = 0


def collect_log(
    *,
    labels: Path,
    detections: Path,
    mapping: Path,
    out: Path,
    skip_bad: bool = False,
    on_progress: Progress | None = None,
) -> LogCounts:
    """Write a row for each of a log's, to a table that is complete or not there.

    ``labels`` and ``detections`` are the log twice, or its file of obstacles and what the detector
    made of each, row by row. Malformed rows are counted and passed over if ``skip_bad``. Rows are
    read and written in batches; ``out`` is CSV unless it ends in .parquet. ``on_progress`` is
    called with thousandths of the log.

    Raises:
        PemError: naming file, line and column of what is malformed, or what is missing; units that
            cannot be; an obstacle that is there twice at a moment.
    """
    plan, counts = read_mapping(mapping), LogCounts()
    batches = log_batches((labels, plan.labels), (detections, plan.detections), wanted=plan.wanted)
    moments, judged = _Moments(labels), list[FloatArray]()

    def write(stream: BinaryIO) -> None:
        with _table_writer(out, stream, plan.written) as write_columns:
            for batch in batches:
                columns, lines = _columns_of(plan, batch, counts, skip_bad=skip_bad)
                moments.add(columns, lines)
                if sum(map(len, judged)) < JUDGED_ROWS:
                    judged.append(np.stack([columns[name] for name in SALIENT_COLUMNS], axis=1))
                write_columns(columns)
                if on_progress is not None:
                    on_progress(round(batch.done * PROGRESS_STEPS), PROGRESS_STEPS)
        if not counts.obstacles:
            raise PemError(f"{labels}: no rows; the first is wrong: {counts.first_bad}")
        try:
            check_plausible(np.concatenate(judged))
        except PemError as error:
            raise PemError(f"{labels}: {error}") from None
        counts.judge(counts.obstacles, labels=labels)
        counts.doubts += moments.checked()

    with writing(out):
        write_atomically(out, write)
    return counts


@contextmanager
def _table_writer(
    out: Path, stream: BinaryIO, names: Sequence[str]
) -> Generator[Callable[[Mapping[str, AnyArray]], None]]:
    """What writes the columns of a batch; numbers keep all digits, NaN is an empty cell."""
    import pyarrow as pa  # noqa: PLC0415  slow to import
    from pyarrow import csv, parquet  # noqa: PLC0415

    types = {**dict.fromkeys(NAMES, pa.string()), "frame": pa.int64()}
    schema: Any = pa.schema([pa.field(name, types.get(name, pa.float64())) for name in names])
    if out.suffix == ".parquet":
        table: Any = parquet.ParquetWriter(stream, schema)
    else:
        stream.write(f"{','.join(names)}\n".encode())
        options = csv.WriteOptions(include_header=False, quoting_style="none")
        table = csv.CSVWriter(stream, schema, write_options=options)

    def write(columns: Mapping[str, AnyArray]) -> None:
        arrays = [pa.array(columns[one.name], one.type, from_pandas=True) for one in schema]
        table.write_table(pa.Table.from_arrays(arrays, schema=schema))

    with table:
        yield write


@dataclass
class _Complaints:
    """What is wrong with which rows of a batch."""

    rows: Columns
    wrong: BoolArray
    said: list[tuple[BoolArray, Callable[[int], str]]] = field(default_factory=list)

    def add(self, wrong: BoolArray, words: Callable[[int], str]) -> None:
        if wrong.any():
            self.wrong |= wrong
            self.said.append((wrong, words))

    def first(self) -> PemError:
        row = int(np.argmax(self.wrong))
        words = next(words for wrong, words in self.said if wrong[row])
        return PemError(f"{self.rows.place(row)}: {words(row)}")


def _columns_of(
    plan: ColumnMapping, batch: LogBatch, counts: LogCounts, *, skip_bad: bool
) -> tuple[dict[str, AnyArray], IntArray]:
    """Columns of the table of a batch's sound rows, and where these stand."""
    rows = batch.rows
    complaints = _Complaints(rows, np.zeros(len(rows), dtype=np.bool_))
    columns: dict[str, AnyArray] = {
        name: _names(plan.columns[name], rows, complaints) for name in NAMES if name in plan.columns
    }
    for name in (*MOMENTS, *SALIENT_COLUMNS, OUTCOME_COLUMN):
        if name in plan.columns:
            columns[name] = _numbers(plan.columns[name], name, rows, complaints)
    outcome = columns[OUTCOME_COLUMN]
    complaints.add(
        ~np.isin(outcome, (0.0, 1.0)), lambda row: f"detected is {outcome[row]:g}, allowed: 0 or 1"
    )
    if ALPHA not in columns:
        turned = columns["rotation_y_rad"] - np.arctan2(columns["x_m"], columns["z_m"])
        columns[ALPHA] = turned - 2.0 * np.pi * np.round(turned / (2.0 * np.pi))
    salient = np.stack([columns[name] for name in SALIENT_COLUMNS], axis=1)
    complaints.add(~known_codes(salient), lambda row: _wrong_code(salient[row]))
    if "frame" in columns:
        frame = columns["frame"]
        is_frame = (frame >= 0.0) & (frame < LARGEST_FRAME) & (frame == np.floor(frame))
        complaints.add(
            ~is_frame, lambda row: f"frame is {frame[row]:g}, allowed: whole numbers from 0 on"
        )
        columns["frame"] = np.where(is_frame, frame, 0.0).astype(np.int64)
    for name in PLANE_COLUMNS:
        if name in plan.columns:
            hits = outcome == 1.0
            values = _numbers(plan.columns[name], name, rows, complaints, counting=hits)
            columns[name] = np.where(hits, values, np.nan)
    if complaints.wrong.any():
        if not skip_bad:
            raise complaints.first()
        counts.bad_lines += int(complaints.wrong.sum())
        counts.first_bad = counts.first_bad or str(complaints.first())
    kept = ~complaints.wrong
    counts.obstacles += int(kept.sum())
    counts.missed += int(np.count_nonzero(outcome[kept] == 0.0))
    return {name: values[kept] for name, values in columns.items()}, rows.lines[kept]


def _wrong_code(salient: FloatArray) -> str:
    try:
        check_rows(salient[None, :])
    except PemError as error:
        return str(error).removeprefix("salient row 0: ")
    return "salient variables are not known"


def _column(source: Source, rows: Columns) -> Any:
    if source.column not in rows.header:
        names = ", ".join(rows.header[:MOST_LISTED])
        raise PemError(f"{rows.place(0)}: no column {source.column!r}, there are: {names}")
    return rows.table.column(source.column)


def _names(source: Source | float, rows: Columns, complaints: _Complaints) -> AnyArray:
    """Texts that name something ``[n]``."""
    if not isinstance(source, Source):
        return np.full(len(rows), f"{source:g}", dtype=object)
    texts = [text_of(cell) for cell in _column(source, rows).to_pylist()]
    wrong = np.array([not text or any(mark in text for mark in SPECIAL) for text in texts])
    complaints.add(
        wrong,
        lambda row: f"{source.column} is {texts[row][:40]!r}, must be a name without commas",
    )
    return np.array(texts, dtype=object)


def _numbers(
    source: Source | float,
    name: str,
    rows: Columns,
    complaints: _Complaints,
    *,
    counting: BoolArray | None = None,
) -> FloatArray:
    """A column of the table ``[n]``, in its unit; where it does not count it may be anything."""
    if not isinstance(source, Source):
        return np.full(len(rows), source)
    column = _column(source, rows)
    if source.values:
        texts = [text_of(cell) for cell in column.to_pylist()]
        values = np.array([source.values.get(text, np.nan) for text in texts])
    else:
        values, _ = numbers_of(column)
    factor = source.times
    if source.unit is not None:
        factor *= unit_factor(source.unit, name, where=name)
    with np.errstate(over="ignore", invalid="ignore"):
        values = factor * values + source.plus
    wrong = ~np.isfinite(values)

    def words(row: int) -> str:
        listed = ", ".join(list(source.values)[:MOST_LISTED])
        cell = text_of(column[row].as_py())[:40]
        allowed = f"one of {listed}" if listed else "a number"
        return f"{source.column}, for {name}, is {cell!r}, allowed: {allowed}"

    complaints.add(wrong if counting is None else wrong & counting, words)
    return values


@dataclass
class _Moments:
    """Who is there when, over all of a log: 28 bytes a row.

    Attributes:
        path: The log, for messages.
    """

    path: Path
    codes: dict[str, dict[str, int]] = field(default_factory=dict[str, dict[str, int]])
    parts: dict[str, list[AnyArray]] = field(default_factory=dict[str, list[AnyArray]])

    def add(self, columns: Mapping[str, AnyArray], lines: IntArray) -> None:
        """Take what names a batch's rows; nothing where obstacles are not followed."""
        if "track" not in columns:
            return
        self._keep("line", lines.astype(np.int32))
        for name in NAMES:
            code = self.codes.setdefault(name, {})
            values, place = np.unique(columns[name].astype(str), return_inverse=True)
            known = [code.setdefault(str(value), len(code)) for value in values]
            self._keep(name, np.array(known, dtype=np.int32)[place])
        for name in MOMENTS:
            if name in columns:
                self._keep(name, columns[name])

    def _keep(self, name: str, values: AnyArray) -> None:
        self.parts.setdefault(name, []).append(values)

    def checked(self) -> tuple[str, ...]:
        """What is to be known of rates and gaps.

        Raises:
            PemError: An obstacle is there twice at a moment, or rates and times differ.
        """
        if not self.parts:
            return ()
        kept = {name: np.concatenate(self.parts.pop(name)) for name in list(self.parts)}
        sequence = kept["sequence"]
        track = sequence * np.int64(len(self.codes["track"])) + kept["track"]
        when = kept.get(TIME_COLUMN, kept.get("frame"))
        assert when is not None  # noqa: S101  the mapping says so
        order = np.lexsort((when, track))
        follows = np.append(False, np.diff(track[order]) == 0)
        apart = np.diff(when[order].astype(np.float64), prepend=0.0)
        self._check_twice(follows & (apart == 0.0), order, kept)
        names = np.array(list(self.codes["sequence"]))
        if TIME_COLUMN in kept:
            rate_hz = rates_of(
                when, sequence=sequence, track=track, names=names, where=str(self.path)
            )
            if RATE_COLUMN in kept:
                check_rates(kept[RATE_COLUMN], rate_hz, names[sequence], where=str(self.path))
            since_s = apart
        else:
            rate_hz = kept[RATE_COLUMN]
            since_s = apart / rate_hz[order]
        since_s = np.where(follows, since_s, np.inf)
        return tuple(clock_words(since_s, rate_hz[order], sequence[order]))

    def _check_twice(self, again: BoolArray, order: IntArray, kept: Mapping[str, AnyArray]) -> None:
        if not again.any():
            return
        place = int(np.argmax(again))
        first, second = sorted(int(row) for row in order[place - 1 : place + 1])
        names = {name: list(self.codes[name])[kept[name][second]] for name in NAMES}
        when = TIME_COLUMN if TIME_COLUMN in kept else "frame"
        raise PemError(
            f"{self.path}:{kept['line'][second]}: track {names['track']} of sequence "
            f"{names['sequence']} is there with {when} {kept[when][second]:.10g} as in line "
            f"{kept['line'][first]} already; {np.count_nonzero(again)} rows are there again: give "
            "each once, as a miss counted twice makes misses seem to follow each other"
        )
