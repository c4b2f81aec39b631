"""The chains of misses of the least robust rollouts, a row each, against time."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import rerun as rr

from pemviz.arrays import BoolArray
from pemviz.colors import DETECTED, MISSED, WHITE, rgba
from pemviz.recording import paths
from pemviz.recording.plot import Axis, Frame, legend, log_axes, number_axis, ui
from pemviz.recording.stream import RecordingFile, StepTimes

ROWS = 8
MISS_HEIGHT = 0.6
"""Of a row."""
THIN = 0.006
"""Half of a detection's height, in heights of the plot."""


def log_outcomes(
    file: RecordingFile, rows: Sequence[tuple[str, BoolArray]], *, stage: int, dt_s: float
) -> None:
    """Misses among the first outcomes ``[T-1]`` with their names, and where the time is."""
    names = [name for name, _ in rows[:ROWS]]
    shown = [outcomes for _, outcomes in rows[:ROWS]]
    frame = outcome_frame(names, steps=shown[0].size, dt_s=dt_s)
    log = partial(file.at_stage, stage=stage)
    log_axes(log, paths.OUTCOMES, frame)
    for rank, detected in enumerate(shown, start=1):
        log(paths.outcomes(rank), _misses(frame, detected, rank=rank, dt_s=dt_s))
    log(
        paths.legend(paths.OUTCOMES),
        legend(frame, [(0, "missed", rgba(MISSED)), (1, "detected", rgba(DETECTED))]),
    )
    times = StepTimes(stage=stage, count=shown[0].size + 1, dt_s=dt_s)
    ends = np.array([frame.y.low, frame.y.high])
    strips = [[frame.places(np.full(2, step * dt_s), ends)] for step in range(times.count)]
    path = paths.part(paths.OUTCOMES, "time")
    file.static(path, rr.LineStrips2D.from_fields(colors=[rgba(WHITE)], radii=[ui(0.7)]))
    file.along(path, rr.LineStrips2D.columns(strips=strips), times=times)


def outcome_frame(names: Sequence[str], *, steps: int, dt_s: float) -> Frame:
    """Time to the right, rows downwards, the first on top."""
    ticks = tuple((float(place), name) for place, name in enumerate(names, start=1))
    y = Axis(low=len(names) + 0.5, high=0.5, ticks=ticks)
    return Frame(x=number_axis(0.0, steps * dt_s, unit="s"), y=y)


def _misses(frame: Frame, detected: BoolArray, *, rank: int, dt_s: float) -> rr.LineStrips2D:
    """A line along the row, and across it a stroke as wide as a step for every miss."""
    whole = frame.places(np.array([0.0, detected.size * dt_s]), np.full(2, float(rank)))
    ends = np.array([rank - MISS_HEIGHT / 2, rank + MISS_HEIGHT / 2])
    middles_s = (np.flatnonzero(~detected) + 0.5) * dt_s
    missed = [frame.places(np.full(2, middle_s), ends) for middle_s in middles_s]
    half_step = frame.shape.width / detected.size / 2.0
    return rr.LineStrips2D(
        [whole, *missed],
        colors=[rgba(DETECTED), *[rgba(MISSED)] * len(missed)],
        radii=[THIN, *[half_step] * len(missed)],
        draw_order=20.0,
    )
