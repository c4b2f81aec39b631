"""The chains of misses of the least robust rollouts, a row each, against time."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import rerun as rr

from pemviz.arrays import BoolArray, FloatArray
from pemviz.colors import DETECTED, GREY, MISSED, WHITE, rgba
from pemviz.recording import paths
from pemviz.recording.plot import (
    NORMAL,
    Axis,
    Frame,
    Shape,
    legend,
    log_axes,
    number_axis,
    ui,
)
from pemviz.recording.stream import RecordingFile, StepTimes

ROWS = 8
MISS_HEIGHT = 0.6
"""Of a row."""
THIN = 0.006
"""Half of a detection's height, in heights of the plot."""
SHORT_NAME = 8
"""Letters of a name that the usual margin holds."""
LONG_NAMES = Shape(left=1.0)


@dataclass(frozen=True, eq=False)
class OutcomeRow:
    """What perception told of one obstacle in one rollout.

    Attributes:
        name: What stands beside the row.
        right: ``[T-1]`` whether it did not err.
        asked: ``[T-1]`` whether there was anything to tell; ``None``: at every step.
    """

    name: str
    right: BoolArray
    asked: BoolArray | None = None


def log_outcomes(
    file: RecordingFile, rows: Sequence[OutcomeRow], *, stage: int, dt_s: float
) -> None:
    """Misses of the first rows with their names, and where the time is."""
    shown = rows[:ROWS]
    steps = shown[0].right.size
    frame = outcome_frame([row.name for row in shown], steps=steps, dt_s=dt_s)
    log = partial(file.at_stage, stage=stage)
    log_axes(log, paths.OUTCOMES, frame)
    for place, row in enumerate(shown, start=1):
        log(paths.outcomes(place), _misses(frame, row, place=place, dt_s=dt_s))
    entries = [(0, "missed", rgba(MISSED)), (1, "detected", rgba(DETECTED))]
    if any(row.asked is not None and not np.all(row.asked) for row in shown):
        entries.append((2, "not in view", rgba(GREY)))
    log(paths.legend(paths.OUTCOMES), legend(frame, entries))
    times = StepTimes(stage=stage, count=steps + 1, dt_s=dt_s)
    ends = np.array([frame.y.low, frame.y.high])
    strips = [[frame.places(np.full(2, step * dt_s), ends)] for step in range(times.count)]
    path = paths.part(paths.OUTCOMES, "time")
    file.static(path, rr.LineStrips2D.from_fields(colors=[rgba(WHITE)], radii=[ui(0.7)]))
    file.along(path, rr.LineStrips2D.columns(strips=strips), times=times)


def outcome_frame(names: Sequence[str], *, steps: int, dt_s: float) -> Frame:
    """Time to the right, rows downwards, the first on top."""
    ticks = tuple((float(place), name) for place, name in enumerate(names, start=1))
    y = Axis(low=len(names) + 0.5, high=0.5, ticks=ticks)
    shape = LONG_NAMES if max(map(len, names)) > SHORT_NAME else NORMAL
    return Frame(x=number_axis(0.0, steps * dt_s, unit="s"), y=y, shape=shape)


def _misses(frame: Frame, row: OutcomeRow, *, place: int, dt_s: float) -> rr.LineStrips2D:
    """A line along the row, and across it a stroke as wide as a step for every miss."""
    steps, wrong = row.right.size, ~row.right
    asked = np.ones(steps, dtype=np.bool_) if row.asked is None else row.asked

    def along(first: int, end: int) -> FloatArray:
        return frame.places(np.array([first, end]) * dt_s, np.full(2, float(place)))

    turns = np.flatnonzero(np.diff(asked)) + 1
    runs = list(pairwise([0, *turns.tolist(), steps]))
    lines = [along(first, end) for first, end in runs]
    shades = [rgba(DETECTED if asked[first] else GREY) for first, _ in runs]
    ends = np.array([place - MISS_HEIGHT / 2, place + MISS_HEIGHT / 2])
    middles_s = (np.flatnonzero(wrong & asked) + 0.5) * dt_s
    missed = [frame.places(np.full(2, middle_s), ends) for middle_s in middles_s]
    half_step = frame.shape.width / steps / 2.0
    return rr.LineStrips2D(
        [*lines, *missed],
        colors=[*shades, *[rgba(MISSED)] * len(missed)],
        radii=[*[THIN] * len(lines), *[half_step] * len(missed)],
        draw_order=20.0,
    )
