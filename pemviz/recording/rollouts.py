"""A stage's rollouts: signals, detections and detection probabilities on ``step``."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from pemviz.arrays import BoolArray, FloatArray, IntArray, row_sums
from pemviz.colors import HOLDS, PEM_ON_BLACK, VIOLATED, Rgba, rgba
from pemviz.recording import paths
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.runs.drawn_rollout import faultless, faultless_probability
from pemviz.simulators.slots import Slot
from pemviz.types import Signal, StageResult, numbers_of

EMPHASISED = 5
THICK = 2.5
THIN = 1.0
PEM_ALPHA = 70
CROWDED = 300
RASTER_RANGE = (-0.23, 1.14)
"""Where the colour map has orange for a miss (0) and blue for a detection (1)."""


def log_rollouts(
    file: RecordingFile,
    stage: StageResult,
    *,
    kept: IntArray,
    signals: Sequence[Signal],
    slots: Sequence[Slot],
    dt_s: float,
) -> None:
    """Log the ``kept`` rollouts of a stage; each entity holds them in that order."""
    scored = stage.scored
    rollouts = scored.rollouts
    steps = rollouts.detected.shape[1]
    number = numbers_of(rollouts.count, stage.drawn)
    names = series_names(number[kept], scored.robustness[kept])
    shades = series_colors(scored.violated[kept])
    widths = series_widths(kept.size)

    def log(part: str, values: FloatArray, colours: Sequence[Rgba]) -> None:
        path = paths.rollouts(stage.stage, part)
        times = StepTimes(stage=stage.stage, count=values.shape[1], dt_s=dt_s)
        file.style(path, names=names, colors=colours, widths=widths)
        file.series(path, values, times=times)

    for signal in signals:
        log(signal.key, rollouts.signals[signal.name][kept], shades)
    grey = [rgba(PEM_ON_BLACK, opacity=PEM_ALPHA)] * kept.size
    log(paths.PEM_SERIES, faultless_probability(rollouts.pem_logit[kept], slots=slots), grey)
    proposal = faultless_probability(rollouts.proposal_logit[kept], slots=slots)
    log(paths.PROPOSAL_SERIES, proposal, shades)
    detected = faultless(rollouts.detected, slots=slots)
    _log_detections(file, stage.stage, detected[kept])
    times = StepTimes(stage=stage.stage, count=steps, dt_s=dt_s)
    sample = slice(None) if stage.drawn is None else stage.drawn.even
    _log_missed_share(
        file, scored.violated[sample], ~detected[sample], times=times, stage=stage.stage
    )
    _log_table(file, stage, kept, number=number[kept])


def series_names(number: IntArray, robustness: FloatArray) -> list[str]:
    """A name for each curve ``[M]``: the rollout's index in its stage and its robustness."""
    named = zip(number.tolist(), robustness.tolist(), strict=True)
    return [f"rollout {rollout}, robustness {level:.3g}" for rollout, level in named]


def series_colors(violated: BoolArray) -> list[Rgba]:
    """Violated or not, the last ``EMPHASISED`` opaque."""
    faint = 110 if violated.size <= CROWDED else 60
    plain = (
        rgba(HOLDS, opacity=faint),
        rgba(VIOLATED, opacity=faint + 40),
    )
    strong = (rgba(HOLDS), rgba(VIOLATED))
    first_strong = violated.size - EMPHASISED
    return [
        (strong if place >= first_strong else plain)[int(flag)]
        for place, flag in enumerate(violated.tolist())
    ]


def series_widths(count: int) -> list[float]:
    """The last ``EMPHASISED`` curves, the least robust, are thick."""
    return [THICK if place >= count - EMPHASISED else THIN for place in range(count)]


def _log_detections(file: RecordingFile, stage: int, detected: BoolArray) -> None:
    """The outcomes as a raster, least robust rollout in the first row."""
    raster = np.ascontiguousarray(detected[::-1].astype(np.uint8))
    file.at_stage(
        paths.rollouts(stage, paths.DETECTED),
        rr.Tensor(
            raster, dim_names=("rollout, least robust on top", "step"), value_range=RASTER_RANGE
        ),
        stage=stage,
    )


def _log_missed_share(
    file: RecordingFile,
    violated: BoolArray,
    missed: BoolArray,
    *,
    times: StepTimes,
    stage: int,
) -> None:
    """The share of all rollouts that missed, for those that violate and those that do not.

    Of a large stage that is not held whole, the share of an even sample.
    """
    path = paths.rollouts(stage, paths.MISSED_SHARE)
    groups = {
        "specification holds": (~violated, rgba(HOLDS)),
        "violated": (violated, rgba(VIOLATED)),
    }
    present = {name: group for name, group in groups.items() if group[0].any()}
    file.style(
        path,
        names=[f"{name} ({int(rows.sum())})" for name, (rows, _) in present.items()],
        colors=[color for _, color in present.values()],
        widths=[2.0] * len(present),
    )
    shares = np.array([missed[rows].mean(axis=0) for rows, _ in present.values()])
    file.series(path, shares, times=times)


def _log_table(
    file: RecordingFile, stage: StageResult, kept: IntArray, *, number: IntArray
) -> None:
    """What identifies and scores each curve, in the curves' order."""
    rollouts, scored = stage.scored.rollouts, stage.scored
    file.at_stage(
        paths.rollouts(stage.stage, paths.TABLE),
        rr.AnyValues(
            rollout=number,
            robustness=scored.robustness[kept],
            violated=scored.violated[kept],
            log_weight=rollouts.log_weight[kept],
            log_p=row_sums(rollouts.log_p)[kept],
        ),
        stage=stage.stage,
    )
