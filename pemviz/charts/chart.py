"""What a chart shows, as data; engines decide how it looks.

Values stand as they are, also on logarithmic axes: an engine puts what is at or below 0, or too
small for the axis, at the axis' end.
"""

from dataclasses import dataclass

from pemviz.arrays import FloatArray

DASHED, DOTTED, SOLID = "5 3", "1.5 2.5", ""
"""Lengths drawn and left out [px]."""


@dataclass(frozen=True)
class Axis:
    """An axis.

    Attributes:
        label: With unit.
        low: Value at its start.
        high: Value at its end.
        log10: Whether equal steps are powers of ten.
        ticks: Where ticks are; chosen by the engine if ``None``.
    """

    label: str
    low: float
    high: float
    log10: bool = False
    ticks: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Rule:
    """A line across the plot at a value.

    Attributes:
        at: The value.
        label: Beside it; empty: none.
        color: ``#rrggbb``.
        dash: As of :data:`DASHED`.
        upright: Whether the value is one of the axis to the right.
    """

    at: float
    label: str
    color: str
    dash: str = DASHED
    upright: bool = True


@dataclass(frozen=True)
class Row:
    """One row of an :class:`IntervalChart`.

    Attributes:
        name: In words.
        low: Lower end of its range; ``None``: not known.
        high: Upper end; ``None`` likewise.
        values: Points within it.
        color: ``#rrggbb``.
        holds: Whether the range is an interval at its level; one that is not is dotted.
        figures: What is said of it in figures.
        tip: Shown where the pointer rests.
        mark: What stands for a value in characters.
    """

    name: str
    low: float | None
    high: float | None
    values: tuple[float, ...]
    color: str
    holds: bool = True
    figures: str = ""
    tip: str = ""
    mark: str = "o"


@dataclass(frozen=True)
class IntervalChart:
    """Ranges of probabilities below each other, on one axis of powers of ten.

    Attributes:
        title: What is shown.
        rows: From the top.
        label: Of the axis.
        rules: Lines across all rows.
        up_to: The axis' upper end; ``None``: what the rows need.
    """

    title: str
    rows: tuple[Row, ...]
    label: str
    rules: tuple[Rule, ...] = ()
    up_to: float | None = None


@dataclass(frozen=True, eq=False)
class Line:
    """A line through points ``[N]``; NaN breaks it. Those without a label are not in the legend."""

    x: FloatArray
    y: FloatArray
    color: str
    label: str = ""
    width: float = 1.8
    dash: str = SOLID
    opacity: float = 1.0
    tip: str = ""


@dataclass(frozen=True, eq=False)
class Points:
    """Discs at ``[N]`` places.

    Attributes:
        x: Places to the right.
        y: Places upwards.
        color: ``#rrggbb``.
        label: In the legend.
        radius: In pixels.
        tips: Of each, shown where the pointer rests.
        clickable: Whether a click gives the number of a point, counted from 1.
    """

    x: FloatArray
    y: FloatArray
    color: str
    label: str = ""
    radius: float = 3.0
    tips: tuple[str, ...] = ()
    clickable: bool = False


@dataclass(frozen=True, eq=False)
class Whiskers:
    """Ranges ``[N]`` upwards; those that are no intervals at their level are dotted."""

    x: FloatArray
    low: FloatArray
    high: FloatArray
    color: str
    holds: tuple[bool, ...]
    label: str = ""


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars from 0 between edges ``[N+1]`` up to heights ``[N]``."""

    edges: FloatArray
    heights: FloatArray
    color: str
    label: str = ""
    tips: tuple[str, ...] = ()


@dataclass(frozen=True)
class Level:
    """A shade of a plane: for values from here up to the level before."""

    low: float
    words: str
    color: str


@dataclass(frozen=True, eq=False)
class Cells:
    """A plane of values, shaded by level.

    Attributes:
        values: ``[up, right]``; NaN where not known.
        levels: From the highest down; the last also has what lies below.
        unknown: Colour where nothing is known.
        title: Of the shades.
    """

    values: FloatArray
    levels: tuple[Level, ...]
    unknown: str
    title: str


@dataclass(frozen=True)
class Box:
    """A dashed rectangle."""

    low_x: float
    high_x: float
    low_y: float
    high_y: float
    color: str
    label: str


Mark = Line | Points | Whiskers | Bars | Cells | Box | Rule


@dataclass(frozen=True)
class PlaneChart:
    """Marks over two axes.

    Attributes:
        title: What is shown.
        x: To the right.
        y: Upwards.
        marks: The first lie below the others.
        width: In pixels, of a page; the height too.
        height: See there.
    """

    title: str
    x: Axis
    y: Axis
    marks: tuple[Mark, ...]
    width: int = 400
    height: int = 190


Chart = IntervalChart | PlaneChart
