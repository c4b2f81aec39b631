"""Charts of intervals in the rerun viewer: a row a source, on one axis of powers of ten."""

import numpy as np
import rerun as rr

from pemviz.charts.chart import IntervalChart, Row, axis_decades, decade
from pemviz.colors import WHITE, rgba
from pemviz.recording import paths
from pemviz.recording.plot import ROWS, Axis, Frame, Log, decade_axis, log_axes, ui, written

WORDS_AT, BAR_AT = 0.05, 0.72
"""Of a row's height, from its top."""


def log_intervals(log: Log, path: str, chart: IntervalChart) -> None:
    """Replace what is drawn at a path: bars, words above them, lines across."""
    frame = interval_frame(chart)
    log_axes(log, path, frame)
    known = [(place, row) for place, row in enumerate(chart.rows) if row.high]
    strips = [_bar(frame, place, row) for place, row in known]
    colors = [rgba(row.color) for _, row in known]
    bars = rr.LineStrips2D(strips, colors=colors, radii=ui(3.0), draw_order=20.0)
    middle, count = 0.5 * frame.shape.width, len(chart.rows)
    places = [(middle, (place + WORDS_AT) / count) for place in range(count)]
    words = [f"{row.name}: {row.figures}" for row in chart.rows]
    white = [rgba(WHITE)] * count
    log(paths.part(path, "sources"), bars, written(places, words, colors=white))
    ends = np.array([frame.y.low, frame.y.high])
    if chart.rules:
        lines = [frame.places(np.full(2, decade(rule.at)), ends) for rule in chart.rules]
        shades = [rgba(rule.color) for rule in chart.rules]
        across = rr.LineStrips2D(lines, colors=shades, radii=ui(0.7), draw_order=10.0)
        log(paths.part(path, "answer"), across)


def interval_frame(chart: IntervalChart) -> Frame:
    """Powers of ten to the right, rows downwards."""
    rows = Axis(low=float(len(chart.rows)), high=0.0, ticks=())
    return Frame(x=decade_axis(*axis_decades(chart)), y=rows, shape=ROWS)


def _bar(frame: Frame, place: int, row: Row) -> np.ndarray:
    ends = np.array([decade(row.low or 0.0), decade(row.high or 0.0)])
    return frame.places(ends, np.full(2, place + BAR_AT))
