"""The uncertainty budget as a recording draws it: a row a source, on one axis of powers of ten."""

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from pemviz.arrays import FloatArray
from pemviz.colors import GREEN, SOURCES, WHITE, rgba
from pemviz.recording import paths
from pemviz.recording.estimates import log10_or_none
from pemviz.recording.plot import ROWS, Axis, Frame, decade_axis, log_axes, ui, written
from pemviz.recording.stream import RecordingFile
from pemviz.reports.uncertainty_text import ends_text, source_name
from pemviz.runs.result import RunResult
from pemviz.runs.uncertainty import UncertaintySource, uncertainty_budget

FARTHEST = -40.0
"""Decades below which nothing is drawn; an end below, or 0, is at the axis' end."""
WORDS_AT, BAR_AT = 0.05, 0.72
"""Of a row's height, from its top."""


def log_uncertainty(file: RecordingFile, result: RunResult) -> None:
    """Replace what is drawn; nothing without an estimate."""
    sources = uncertainty_budget(result)
    if not sources:
        return
    frame = uncertainty_frame(sources)
    log_axes(file.static, paths.UNCERTAINTY, frame)
    known = [(row, source) for row, source in enumerate(sources) if source.high]
    bars = [_bar(frame, row, source) for row, source in known]
    colors = [rgba(SOURCES[source.kind]) for _, source in known]
    drawn = rr.LineStrips2D(bars, colors=colors, radii=ui(3.0), draw_order=20.0)
    middle = 0.5 * frame.shape.width
    places = [(middle, (row + WORDS_AT) / len(sources)) for row in range(len(sources))]
    words = [_words(source) for source in sources]
    white = [rgba(WHITE)] * len(words)
    file.static(
        paths.part(paths.UNCERTAINTY, "sources"), drawn, written(places, words, colors=white)
    )
    estimate = None if result.estimate is None else result.estimate.log10_probability
    if estimate is not None:
        ends = np.array([frame.y.low, frame.y.high])
        strip = frame.places(np.full(2, estimate), ends)
        line = rr.LineStrips2D([strip], colors=rgba(GREEN), radii=ui(0.7), draw_order=10.0)
        file.static(paths.part(paths.UNCERTAINTY, "answer"), line)


def uncertainty_frame(sources: Sequence[UncertaintySource]) -> Frame:
    """Powers of ten to the right up to 1, sources downwards."""
    ends = [math.log10(end) for source in sources for end in (source.low, source.high) if end]
    low = max(min(ends, default=-20.0) - 1.0, FARTHEST)
    return Frame(
        x=decade_axis(low, 0.0), y=Axis(low=float(len(sources)), high=0.0, ticks=()), shape=ROWS
    )


def _bar(frame: Frame, row: int, source: UncertaintySource) -> FloatArray:
    low, high = log10_or_none(source.low), log10_or_none(source.high)
    ends = np.array([FARTHEST if low is None else low, frame.x.high if high is None else high])
    return frame.places(ends, np.full(2, row + BAR_AT))


def _words(source: UncertaintySource) -> str:
    """A source's name up to the reasons, which the table beside tells, and its ends."""
    name = source_name(source).partition(";")[0]
    if source.high is None:
        return f"{name}: not bounded"
    low, high = ends_text(source)
    return f"{name}: {low} to {high}"
