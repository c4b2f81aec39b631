"""The ladder of uncertainty as a recording draws it: a row a rung, on one axis of powers of ten."""

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from pemviz.arrays import FloatArray
from pemviz.colors import GREEN, RUNGS, WHITE, rgba
from pemviz.recording import paths
from pemviz.recording.estimates import log10_or_none
from pemviz.recording.plot import ROWS, Axis, Frame, decade_axis, log_axes, ui, written
from pemviz.recording.stream import RecordingFile
from pemviz.reports.ladder_text import ends_text, rung_name
from pemviz.runs.ladder import Rung, uncertainty_ladder
from pemviz.runs.result import RunResult

FARTHEST = -40.0
"""Decades below which nothing is drawn; an end below, or 0, is at the axis' end."""
WORDS_AT, BAR_AT = 0.05, 0.72
"""Of a row's height, from its top."""


def log_ladder(file: RecordingFile, result: RunResult) -> None:
    """Replace what is drawn; nothing without an estimate."""
    rungs = uncertainty_ladder(result)
    if not rungs:
        return
    frame = ladder_frame(rungs)
    log_axes(file.static, paths.LADDER, frame)
    known = [(row, rung) for row, rung in enumerate(rungs) if rung.high]
    bars = [_bar(frame, row, rung) for row, rung in known]
    colors = [rgba(RUNGS[rung.kind]) for _, rung in known]
    drawn = rr.LineStrips2D(bars, colors=colors, radii=ui(3.0), draw_order=20.0)
    middle = 0.5 * frame.shape.width
    places = [(middle, (row + WORDS_AT) / len(rungs)) for row in range(len(rungs))]
    words = [_words(rung) for rung in rungs]
    white = [rgba(WHITE)] * len(words)
    file.static(paths.part(paths.LADDER, "rungs"), drawn, written(places, words, colors=white))
    estimate = None if result.estimate is None else result.estimate.log10_probability
    if estimate is not None:
        ends = np.array([frame.y.low, frame.y.high])
        strip = frame.places(np.full(2, estimate), ends)
        line = rr.LineStrips2D([strip], colors=rgba(GREEN), radii=ui(0.7), draw_order=10.0)
        file.static(paths.part(paths.LADDER, "answer"), line)


def ladder_frame(rungs: Sequence[Rung]) -> Frame:
    """Powers of ten to the right up to 1, rungs downwards."""
    ends = [math.log10(end) for rung in rungs for end in (rung.low, rung.high) if end]
    low = max(min(ends, default=-20.0) - 1.0, FARTHEST)
    return Frame(
        x=decade_axis(low, 0.0), y=Axis(low=float(len(rungs)), high=0.0, ticks=()), shape=ROWS
    )


def _bar(frame: Frame, row: int, rung: Rung) -> FloatArray:
    low, high = log10_or_none(rung.low), log10_or_none(rung.high)
    ends = np.array([FARTHEST if low is None else low, frame.x.high if high is None else high])
    return frame.places(ends, np.full(2, row + BAR_AT))


def _words(rung: Rung) -> str:
    """A rung's name up to the reasons, which the table beside tells, and its ends."""
    name = rung_name(rung).partition(";")[0]
    if rung.high is None:
        return f"{name}: not bounded"
    low, high = ends_text(rung)
    return f"{name}: {low} to {high}"
