"""What a chart shows: lines over one axis, told apart by colour and dash."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.colors import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from pemviz.types import Signal

RUN_COLORS = (VERMILLION, BLUE, GREEN, PURPLE, ORANGE, SKY)
RUN_DASHES = ((), (6, 3), (2, 3), (9, 3, 2, 3), (12, 4), (4, 4))
"""Of runs side by side, in their order: as many as can be told apart."""


@dataclass(frozen=True, eq=False)
class Line:
    """One line.

    Attributes:
        name: In the legend.
        values: ``[X]``; NaN where there is none.
        color: ``#rrggbb``.
        width: In pixels.
        dash: Lengths drawn and left out, in pixels; empty: unbroken.
    """

    name: str
    values: FloatArray
    color: str
    width: float = 1.8
    dash: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Curves:
    """Lines over one axis.

    Attributes:
        title: What is shown.
        x: ``[X]`` ascending.
        x_label: With unit.
        y_label: With unit.
        lines: Each over ``x``.
        y_range: Ends of the vertical axis; ``None``: what the lines need.
    """

    title: str
    x: FloatArray
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    y_range: tuple[float, float] | None = None


def signal_name(signal: Signal) -> str:
    """A signal in words."""
    return signal.name.replace("_", " ")


def in_brackets(unit: str) -> str:
    """A unit behind words; nothing without one."""
    return f" [{unit}]" if unit else ""


def signal_label(signal: Signal) -> str:
    """A signal in words with its unit."""
    return signal_name(signal) + in_brackets(signal.unit)


def over_common(x: FloatArray, grids: Sequence[tuple[FloatArray, FloatArray]]) -> list[FloatArray]:
    """Lines ``(x, y)`` on a common axis; NaN beyond their ends and where they have none."""
    shown: list[FloatArray] = []
    for own_x, y in grids:
        known = np.isfinite(y)
        if not np.any(known):
            shown.append(np.full(x.size, np.nan))
            continue
        shown.append(np.interp(x, own_x[known], y[known], left=np.nan, right=np.nan))
    return shown
