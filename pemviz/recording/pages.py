"""A recording of pages: text, and a picture or curves against time beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from pemviz.arrays import FloatArray
from pemviz.colors import BLUE, GREEN, VERMILLION
from pemviz.recording import paths
from pemviz.recording.shades import shade
from pemviz.recording.stream import RecordingFile, StepTimes, blueprint_of

TEXT, PICTURE, SERIES = "text", "picture", "series"
SERIES_COLORS = tuple(map(shade, (BLUE, VERMILLION, GREEN)))


@dataclass(frozen=True)
class Page:
    """One tab: a text, and beside it a picture or curves ``[T]`` by name, against time.

    Attributes:
        name: Part of its entity paths.
        series_title: Says what the curves are, with their unit.
    """

    name: str
    title: str
    markdown: str
    png: bytes | None = None
    series: Mapping[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    series_title: str = ""
    dt_s: float = 1.0


def write_pages(path: Path, pages: Sequence[Page], *, name: str) -> None:
    """Write a recording that opens with one tab a page, over one that is there.

    Raises:
        RunError: It cannot be written.
    """
    recording = RecordingFile(path, name=name, layout="pages")
    time_panel = rrb.TimePanel(timeline=paths.SIM_TIME, state="collapsed")
    recording.blueprint(blueprint_of(rrb.Tabs(*map(_tab, pages)), time_panel))
    for page in pages:
        recording.markdown(paths.page(page.name, TEXT), page.markdown)
        if page.png is not None:
            picture = rr.EncodedImage(contents=page.png, media_type="image/png")
            recording.static(paths.page(page.name, PICTURE), picture)
        if page.series:
            _log_series(recording, page)
    recording.close()


def _log_series(recording: RecordingFile, page: Page) -> None:
    values = np.stack(list(page.series.values()))
    path = paths.page(page.name, SERIES)
    colors = [SERIES_COLORS[index % len(SERIES_COLORS)] for index in range(len(values))]
    recording.style(path, names=list(page.series), colors=colors, widths=[2.0] * len(values))
    times = StepTimes(stage=0, count=values.shape[1], dt_s=page.dt_s)
    recording.series(path, values, times=times)


def _tab(page: Page) -> rrb.Container:
    text = rrb.TextDocumentView(name=page.title, contents=[paths.page(page.name, TEXT)])
    beside: list[rrb.View] = []
    if page.png is not None:
        picture = [paths.page(page.name, PICTURE)]
        beside.append(rrb.Spatial2DView(name=f"{page.title}: picture", contents=picture))
    if page.series:
        series = [paths.page(page.name, SERIES)]
        beside.append(rrb.TimeSeriesView(name=page.series_title, contents=series))
    if not beside:
        return rrb.Vertical(text, name=page.title)
    return rrb.Horizontal(text, rrb.Vertical(*beside), name=page.title, column_shares=[1, 2])
