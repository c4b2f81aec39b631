"""Estimates with their intervals, drawn as points with error bars on a scale of powers of ten."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import rerun as rr

from pemviz.arrays import FloatArray
from pemviz.colors import GREEN, GREY, ORANGE, SKY, rgba
from pemviz.recording import paths
from pemviz.recording.plot import (
    Axis,
    Frame,
    Log,
    decade_axis,
    dots,
    legend,
    log_axes,
    number_axis,
    ui,
    whiskers,
)
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

MOST_DECADES = 12.0
"""Below the highest; what is lower still lies on the axis' end."""
MOST_WHISKERS = 2_000


@dataclass(frozen=True)
class Drawn:
    """An estimate as it is drawn; logarithms to base 10.

    Attributes:
        place: Stage or repetition.
        log10: Of the estimate.
        low: Lower end of its interval; ``None`` where unknown.
        high: Upper end; ``None`` likewise.
        holds: Whether the interval holds at its level.
    """

    place: int
    log10: float
    low: float | None
    high: float | None
    holds: bool


@dataclass(frozen=True)
class Answer:
    """The run's answer as it is drawn beside them; logarithms to base 10."""

    log10: float
    low: float | None
    high: float | None


def stage_axis(stages: int) -> Axis:
    """An axis of so many stages."""
    return number_axis(-0.5, max(stages, 1) - 0.5, whole=True)


def log_estimates(
    log: Log, path: str, estimates: Sequence[Drawn], *, places: int, answer: Answer | None
) -> None:
    """All estimates, and the answer across them; nothing where there is no estimate."""
    frame = _frame(estimates, places=places, answer=answer)
    if frame is None:
        return
    log_axes(log, path, frame)
    x = np.array([float(one.place) for one in estimates])
    y = np.array([one.log10 for one in estimates])
    points = dots(frame, x, y, colors=[rgba(ORANGE)] * x.size)
    barred = [one for one in estimates if one.low is not None and one.high is not None]
    intervals = whiskers(
        frame,
        np.array([float(one.place) for one in barred]),
        _ends(barred, "low"),
        _ends(barred, "high"),
        colors=[rgba(SKY if one.holds else GREY) for one in barred],
    )
    log(paths.part(path, "values"), points, *([intervals] if len(barred) <= MOST_WHISKERS else []))
    held = {one.holds for one in barred}
    words = [
        (0, "estimate", rgba(ORANGE)),
        *([(1, "95 % interval", rgba(SKY))] if True in held else []),
        *([(2, "not a 95 % one", rgba(GREY))] if False in held else []),
        *([] if answer is None else [(3, f"answer {10.0**answer.log10:.2g}", rgba(GREEN))]),
    ]
    log(paths.legend(path), legend(frame, words))
    if answer is not None:
        log(paths.part(path, "answer"), _across(frame, answer))


def _ends(estimates: Sequence[Drawn], name: str) -> FloatArray:
    return np.array([float(getattr(one, name)) for one in estimates])


def _frame(estimates: Sequence[Drawn], *, places: int, answer: Answer | None) -> Frame | None:
    ends = [end for one in (*estimates, *([] if answer is None else [answer]))
            for end in (one.log10, one.low, one.high) if end is not None]  # fmt: skip
    if not estimates:
        return None
    high = max(ends)
    return Frame(x=stage_axis(places), y=decade_axis(max(min(ends), high - MOST_DECADES), high))


def _across(frame: Frame, answer: Answer) -> Any:
    """The answer as a line, dashed at the ends of its interval."""
    ends = np.array([frame.x.low, frame.x.high])
    strips = [frame.places(ends, np.full(2, answer.log10))]
    dashes = np.linspace(frame.x.low, frame.x.high, 61)
    for end in (answer.low, answer.high):
        if end is not None:
            strips += [
                frame.places(np.array(pair), np.full(2, end))
                for pair in list(pairwise(dashes.tolist()))[::2]
            ]
    return rr.LineStrips2D(strips, colors=rgba(GREEN), radii=ui(0.7), draw_order=10.0)


def drawn_repetitions(estimates: Sequence[Estimate]) -> list[Drawn]:
    """Those that have a logarithm, by their place."""
    return [
        Drawn(
            place=place,
            log10=one.log10_probability,
            low=log10_or_none(one.ci_low),
            high=log10_or_none(one.ci_high),
            holds=not interval_caveats(one),
        )
        for place, one in enumerate(estimates)
        if one.log10_probability is not None
    ]


def drawn_answer(estimate: Estimate | None) -> Answer | None:
    """The answer as it is drawn; ``None`` without one, or if nothing failed."""
    if estimate is None or estimate.log10_probability is None:
        return None
    ends = log10_or_none(estimate.ci_low), log10_or_none(estimate.ci_high)
    return Answer(estimate.log10_probability, *ends)


def log10_or_none(value: float | None) -> float | None:
    """The logarithm of a positive figure."""
    return math.log10(value) if value is not None and value > 0.0 else None
