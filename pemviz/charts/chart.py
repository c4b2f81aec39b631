"""What a chart shows, as data; engines decide how it looks.

Values stand as they are, also on logarithmic axes: an engine puts what is at or below 0, or too
small for the axis, at the axis' end.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeVar

from pemviz.arrays import FloatArray

Number = TypeVar("Number", float, FloatArray)

DASHED, DOTTED, SOLID = "5 3", "1.5 2.5", ""
"""Lengths drawn and left out [px]."""


@dataclass(frozen=True)
class Axis:
    """An axis between two values; its label has the unit, and ticks are chosen if ``None``.

    ``words`` stand at the ticks in place of numbers: values are then of kinds, not of amounts.
    """

    low: float
    high: float
    label: str
    log10: bool = False
    ticks: tuple[float, ...] | None = None
    words: tuple[str, ...] = ()

    def share(self, value: Number) -> Number:
        """How far along the axis values lie: 0 at its start, 1 at its end."""
        return (value - self.low) / (self.high - self.low)


def with_unit(name: str, unit: str) -> str:
    """A quantity's label: ``gap [m]``."""
    return f"{name} [{unit}]" if unit else name


@dataclass(frozen=True)
class Rule:
    """A line across the plot at a value: of the axis to the right if ``upright``.

    ``label_at``: Where the label of one that is not upright stands: where the axis ends or begins,
    or in the legend.
    """

    at: float
    label: str
    color: str
    dash: str = DASHED
    upright: bool = True
    label_at: Literal["end", "start", "legend"] = "end"


@dataclass(frozen=True)
class Row:
    """One row of an :class:`IntervalChart`: a range, ``None`` where not known, and points in it.

    Attributes:
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

    The axis ends at ``up_to``; if that is ``None``, where the rows do.
    """

    title: str
    rows: tuple[Row, ...]
    label: str
    rules: tuple[Rule, ...] = ()
    up_to: float | None = None


@dataclass(frozen=True, eq=False)
class Line:
    """A line through points ``[N]``; NaN breaks it.

    One without a label is not in the legend; ``name`` is then what tables call it.
    """

    x: FloatArray
    y: FloatArray
    color: str
    label: str = ""
    width: float = 1.8
    dash: str = SOLID
    opacity: float = 1.0
    tip: str = ""
    name: str = ""


@dataclass(frozen=True, eq=False)
class Points:
    """Discs at ``[N]`` places, or crosses, a tip each.

    Attributes:
        radius: Of all, or ``[N]`` of each [px].
        numbers: What a click on each gives; none: they take no clicks.
        crosses: Whether they are crosses.
        joined: Whether a line goes through them.
        name: What tables call them if they have no label.
    """

    x: FloatArray
    y: FloatArray
    color: str
    label: str = ""
    radius: float | FloatArray = 3.0
    tips: tuple[str, ...] = ()
    numbers: tuple[int, ...] = ()
    crosses: bool = False
    joined: bool = False
    name: str = ""


@dataclass(frozen=True, eq=False)
class Strokes:
    """Short upright strokes at ``[N]`` places, from ``below`` them to ``above``, in values of y."""

    x: FloatArray
    y: FloatArray
    color: str
    label: str
    above: float = 0.0
    below: float = 0.0


@dataclass(frozen=True, eq=False)
class Whiskers:
    """Ranges ``[N]`` upwards; those that are no intervals at their level are dotted."""

    x: FloatArray
    low: FloatArray
    high: FloatArray
    color: str
    holds: tuple[bool, ...]
    label: str = ""


@dataclass(frozen=True)
class Band:
    """A range upwards all across the plot; one that is no interval at its level is dotted."""

    low: float
    high: float
    color: str
    label: str
    holds: bool = True


@dataclass(frozen=True)
class Veil:
    """What lies beyond a value of the axis to the right is made faint."""

    at: float
    label: str


@dataclass(frozen=True, eq=False)
class Bars:
    """Bars from 0 between edges ``[N+1]`` up to heights ``[N]``; NaN leaves one out."""

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
    """A plane of values ``[up, right]``, NaN where not known, shaded by level.

    Levels come from the highest down; the last also has what lies below. The title is that of the
    levels' words, ``quantity`` what the values are.
    """

    values: FloatArray
    levels: tuple[Level, ...]
    unknown: str
    title: str
    quantity: str


@dataclass(frozen=True)
class Box:
    """A dashed rectangle."""

    low_x: float
    high_x: float
    low_y: float
    high_y: float
    color: str
    label: str


Mark = Line | Points | Strokes | Whiskers | Band | Bars | Cells | Box | Rule | Veil


@dataclass(frozen=True)
class PlaneChart:
    """Marks over two axes, the first below the others; as large in pixels on a page."""

    title: str
    x: Axis
    y: Axis
    marks: tuple[Mark, ...]
    width: int = 400
    height: int = 190


Chart = IntervalChart | PlaneChart

FARTHEST = -60.0
"""Decades below which nothing is drawn."""


def decade(value: float, *, low: float = -math.inf, high: float = math.inf) -> float:
    """The decimal logarithm of a value, within the axis; of one at or below 0 its lower end."""
    if math.isnan(value):
        return value
    found = math.log10(value) if value > 0.0 else -math.inf
    return min(max(found, low, FARTHEST), high)


def axis_decades(chart: IntervalChart) -> tuple[float, float]:
    """Whole decades that hold all rows and rules, and one more below."""
    ends = [end for row in chart.rows for end in (row.low, row.high, *row.values)]
    ends += [rule.at for rule in chart.rules]
    found = [decade(end) for end in ends if end is not None and 0.0 < end < math.inf]
    if not found:
        return -20.0, 0.0
    high = math.ceil(max(found) - 1e-9) if chart.up_to is None else math.log10(chart.up_to)
    low = max(math.floor(min(found)) - 1.0, FARTHEST)
    return low, float(max(high, low + 2.0))


def nice_ticks(low: float, high: float, *, count: int, whole: bool = False) -> list[float]:
    """Round tick positions in ``[low, high]``, about so many."""
    span = high - low
    if not span > 0.0 or not math.isfinite(span):
        return [low]
    raw = span / max(count, 1)
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 5, 10) if unit * m >= raw * 0.999)
    if whole:
        step = max(1.0, round(step))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [0.0 if index == 0 else index * step for index in range(first, last + 1)]
