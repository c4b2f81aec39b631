"""Pictures of the page: frames with boxes, the detector's curve, predictions over the truth."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from pemviz import colors
from studies.detector_in_the_loop.camera import HEIGHT_PX, WIDTH_PX
from studies.detector_in_the_loop.detector import Detector
from studies.detector_in_the_loop.drives import DT_S, LANE_M
from studies.detector_in_the_loop.frames import frames_at
from studies.detector_in_the_loop.page_words import VARIANT_TITLES, holds, ratio_of
from studies.detector_in_the_loop.render import Images, render
from studies.detector_in_the_loop.scene import (
    DOMAINS,
    LIGHTS,
    WEATHERS,
    Scenes,
    draw_scenes,
)
from studies.detector_in_the_loop.settings import seeds

if TYPE_CHECKING:
    from studies.detector_in_the_loop.study import Row, Truth

SHOWN = (
    ("day, dry", "fair"),
    ("low sun, dry", "fair"),
    ("dusk, dry", "fair"),
    ("day, rain", "rain"),
    ("dusk, rain", "rain"),
    ("day, fog", "fog"),
)
NEAR_M = (9.0, 22.0, 45.0)
PICTURES = 90
SCALE = 2
COLOURS = (
    *(colors.GREY, colors.BLUE, colors.ORANGE, colors.GREEN, colors.VERMILLION, colors.BLACK),
)
MARKS = ("s", "v", "o", "^", "D", "<")
"""Of the variants, in order."""
FOUND = (60, 230, 90)


def shown_scenes(kind: str, domain: str, count: int) -> Scenes:
    """Some scenes of a kind of light and weather."""
    drawn = draw_scenes(DOMAINS[domain], count=200, cars=2, seeds=seeds(PICTURES))
    names = [
        f"{LIGHTS[int(light)]}, {WEATHERS[int(weather)]}"
        for light, weather in zip(drawn.column("light"), drawn.column("weather"), strict=True)
    ]
    return drawn.take(np.array([place for place, name in enumerate(names) if name == kind][:count]))


def write_frames(path: Path, detector: Detector) -> None:
    """A row for each kind of light and weather, the lead car farther from one to the next.

    Detections above the usual threshold are framed.

    Raises:
        OSError: It cannot be written.
    """
    rows = []
    for kind, domain in SHOWN:
        scenes = shown_scenes(kind, domain, len(NEAR_M))
        poses = np.zeros((scenes.count, 3, 4))
        poses[:, 0, 1] = NEAR_M[: scenes.count]
        poses[:, 1, 0], poses[:, 1, 1] = LANE_M, np.array(NEAR_M)[: scenes.count] * 0.7 + 5.0
        poses[:, 2, 0], poses[:, 2, 1] = -LANE_M, scenes.column("traffic_m")
        frames = frames_at(
            scenes,
            step=np.array([1.0, 5.0, 9.0])[: scenes.count],
            dt_s=DT_S,
            poses=poses,
            travelled_m=np.full(scenes.count, 20.0),
        )
        images = render(scenes, frames)
        rows.append(np.concatenate(list(framed(images, detector)), axis=1))
    picture = Image.fromarray(np.concatenate(rows, axis=0)).quantize(128)
    picture.save(path, optimize=True)


def framed(images: Images, detector: Detector) -> Images:
    """Images ``[N, ...]`` enlarged, with detections in green."""
    found = detector.detect(images)
    large = images.repeat(SCALE, axis=1).repeat(SCALE, axis=2)
    for row in range(len(images)):
        for place in np.flatnonzero(found.score[row] >= detector.threshold):
            left, top, right, bottom = (SCALE * found.box_px[row, place]).round().astype(int)
            right, bottom = min(right, SCALE * WIDTH_PX - 1), min(bottom, SCALE * HEIGHT_PX - 1)
            large[row, top : bottom + 1, [left, right]] = FOUND
            large[row, [top, bottom], left : right + 1] = FOUND
    return large


def write_curve(path: Path, card: Path) -> None:
    """Precision over recall.

    Raises:
        OSError: It cannot be written.
    """
    told = json.loads(card.read_text(encoding="utf-8"))
    figure = Figure(figsize=(4.2, 3.2), layout="constrained")
    axes = figure.subplots()
    curve = told["curve"]
    axes.plot(curve["recall"], curve["precision"], color="0.2")
    place = int(np.searchsorted(-np.array(curve["threshold"]), -told["threshold"]))
    axes.plot(curve["recall"][place], curve["precision"][place], "o", color=colors.VERMILLION)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=100)


def write_ratios(path: Path, rows: "Sequence[Row]", found: "Mapping[str, Truth]") -> None:
    """Predictions over the truth, by setting: a colour a variant, larger with more frames.

    Raises:
        OSError: It cannot be written.
    """
    names = [name for name in found if any(row.setting == name for row in rows)]
    frames = sorted({row.frames for row in rows})
    figure = Figure(figsize=(8.0, 0.9 + 0.62 * len(names)), layout="constrained")
    axes = figure.subplots()
    axes.add_patch(Rectangle((0.5, -1), 1.5, len(names) + 1, color="0.9", zorder=0))
    axes.axvline(1.0, color="0.4", lw=0.8)
    colours = dict(zip(VARIANT_TITLES, COLOURS, strict=True))
    marks = dict(zip(VARIANT_TITLES, MARKS, strict=True))
    for row in rows:
        if row.setting not in names:
            continue
        ratio = ratio_of(row.answer, found[row.setting])
        if not ratio.value:
            continue
        variant = list(VARIANT_TITLES).index(row.variant)
        height = names.index(row.setting) + 0.13 * (variant - 2.5)
        size = 3.0 + 2.0 * frames.index(row.frames)
        colour = colours[row.variant]
        fill = colour if holds(ratio) else "white"
        axes.plot(ratio.value, height, marks[row.variant], ms=size, color=colour, mfc=fill)
        axes.plot([ratio.low, ratio.high], [height, height], color=colour, lw=0.7)
    shown = {row.variant for row in rows}
    for variant, title in VARIANT_TITLES.items():
        if variant not in shown:
            continue
        axes.plot([], [], marks[variant], color=colours[variant], label=title)
    axes.set(xscale="log", ylim=(len(names) - 0.4, -0.6))
    axes.set_xlabel("prediction over truth (filled: within a factor of 2, the grey band)")
    axes.set_yticks(range(len(names)), names)
    axes.legend(fontsize=7, loc="upper left")
    figure.savefig(path, dpi=100)
