"""A stage's rollouts: which are kept, their signals, detections and P(detected) on ``step``."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from pemviz.arrays import BoolArray, FloatArray, IntArray, row_sums
from pemviz.colors import HOLDS, PEM_IN_RECORDING, VIOLATED, Rgba
from pemviz.recording import paths
from pemviz.recording.shades import shade
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.runs.drawn_rollout import faultless, faultless_probability
from pemviz.simulators.slots import Slot
from pemviz.types import RolloutBatch, Signal, StageResult, numbers_of

ROLLOUT_LIMIT = 3000
SMALLEST_STAGE = 10
LEAST_ROBUST_SHARE = 4
EMPHASISED = 5
THICK = 2.5
THIN = 1.0
PEM_ALPHA = 70
CROWDED = 300
RASTER_RANGE = (-0.23, 1.14)
"""Where the colour map has orange for a miss (0) and blue for a detection (1)."""


def unvaried(rollouts: RolloutBatch) -> frozenset[str]:
    """Signals that are the same in all rollouts, if others differ: what is missed does not matter.

    Where all signals are the same, as without a miss, nothing is known of any.
    """
    same = {name for name, values in rollouts.signals.items() if not np.any(values != values[:1])}
    return frozenset() if len(same) == len(rollouts.signals) else frozenset(same)


def quota(*, rollouts: int, stages: int, limit: int = ROLLOUT_LIMIT) -> int | None:
    """How many rollouts are kept of each stage of a repetition; ``None``: all."""
    return None if rollouts <= limit else max(SMALLEST_STAGE, limit // max(stages, 1))


def quota_text(per_stage: int | None) -> str:
    """How many are kept, in a sentence."""
    if per_stage is None:
        return "Every rollout is recorded."
    least = per_stage // LEAST_ROBUST_SHARE
    return (
        f"There are too many rollouts to record them all: of a stage with more than {per_stage}, "
        f"the {least} least robust and an even sample of {per_stage - least} others are recorded. "
        "Figures and texts count all of them."
    )


def choose(
    robustness: FloatArray, per_stage: int | None, *, even: BoolArray | None = None
) -> IntArray:
    """Indices of the kept rollouts ``[M]`` among ``[N]``, most robust first.

    A viewer draws in this order, so that the least robust end up on top.

    Args:
        robustness: ``[N]``.
        per_stage: How many are kept, see :func:`quota`.
        even: Which of the N are an even sample of more, ``[N]``, where the others are not.
    """
    order = np.argsort(-robustness, kind="stable").astype(np.int64)
    if per_stage is None or order.size <= per_stage:
        return order
    least = per_stage // LEAST_ROBUST_SHARE
    others = np.sort(order[: order.size - least])
    if even is not None:
        others = others[even[others]]
    places = np.linspace(0, others.size - 1, per_stage - least).round().astype(np.int64)
    chosen = np.zeros(order.size, dtype=np.bool_)
    chosen[others[places]] = True
    chosen[order[order.size - least :]] = True
    return order[chosen[order]]


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
    number = numbers_of(rollouts.count, stage.sampled)
    named = zip(number[kept].tolist(), scored.robustness[kept].tolist(), strict=True)
    names = [f"rollout {rollout}, robustness {level:.3g}" for rollout, level in named]
    colors = series_colors(scored.violated[kept])
    # the least robust, which are drawn last, are thick
    thin = max(kept.size - EMPHASISED, 0)
    widths = [THIN] * thin + [THICK] * (kept.size - thin)

    def log(part: str, values: FloatArray, colours: Sequence[Rgba]) -> None:
        path = paths.rollouts(stage.stage, part)
        times = StepTimes(stage=stage.stage, count=values.shape[1], dt_s=dt_s)
        file.style(path, names=names, colors=colours, widths=widths)
        file.series(path, values, times=times)

    for signal in signals:
        log(signal.key, rollouts.signals[signal.name][kept], colors)
    grey = [shade(PEM_IN_RECORDING, opacity=PEM_ALPHA)] * kept.size
    log(paths.PEM_SERIES, faultless_probability(rollouts.pem_logit[kept], slots=slots), grey)
    proposal = faultless_probability(rollouts.proposal_logit[kept], slots=slots)
    log(paths.PROPOSAL_SERIES, proposal, colors)
    detected = faultless(rollouts.detected, slots=slots)
    # the least robust rollout in the first row
    raster = np.ascontiguousarray(detected[kept][::-1].astype(np.uint8))
    dimensions = ("rollout, least robust on top", "step")
    tensor = rr.Tensor(raster, dim_names=dimensions, value_range=RASTER_RANGE)
    file.at_stage(paths.rollouts(stage.stage, paths.DETECTED), tensor, stage=stage.stage)
    _log_missed_share(file, stage, detected, dt_s=dt_s)
    file.at_stage(
        paths.rollouts(stage.stage, paths.TABLE),
        rr.AnyValues(
            rollout=number[kept],
            robustness=scored.robustness[kept],
            violated=scored.violated[kept],
            log_weight=rollouts.log_weight[kept],
            log_p=row_sums(rollouts.log_p)[kept],
        ),
        stage=stage.stage,
    )


def series_colors(violated: BoolArray) -> list[Rgba]:
    """Violated or not, the last ``EMPHASISED`` opaque."""
    faint = 110 if violated.size <= CROWDED else 60
    plain = (shade(HOLDS, opacity=faint), shade(VIOLATED, opacity=faint + 40))
    strong = (shade(HOLDS), shade(VIOLATED))
    first_strong = violated.size - EMPHASISED
    return [
        (strong if place >= first_strong else plain)[int(flag)]
        for place, flag in enumerate(violated.tolist())
    ]


def _log_missed_share(
    file: RecordingFile, stage: StageResult, detected: BoolArray, *, dt_s: float
) -> None:
    """The share of all rollouts that missed, for those that violate and those that do not.

    Of a large stage that is not held whole, the share of an even sample.
    """
    path = paths.rollouts(stage.stage, paths.MISSED_SHARE)
    sample = slice(None) if stage.sampled is None else stage.sampled.even
    violated, missed = stage.scored.violated[sample], ~detected[sample]
    groups = [
        ("specification holds", ~violated, shade(HOLDS)),
        ("violated", violated, shade(VIOLATED)),
    ]
    present = [group for group in groups if group[1].any()]
    file.style(
        path,
        names=[f"{name} ({int(rows.sum())})" for name, rows, _ in present],
        colors=[color for *_, color in present],
        widths=[2.0] * len(present),
    )
    shares = np.array([missed[rows].mean(axis=0) for _, rows, _ in present])
    times = StepTimes(stage=stage.stage, count=missed.shape[1], dt_s=dt_s)
    file.series(path, shares, times=times)
