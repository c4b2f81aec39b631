"""The rows of a benchmark table."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured figure.

    Attributes:
        name: What was measured.
        value: The figure.
        unit: Its unit; empty for a ratio.
        goal: What it should be, in words; empty where nothing is asked.
    """

    name: str
    value: float
    unit: str = ""
    goal: str = ""


def as_cell(value: float | None) -> str:
    """``value`` in three digits, ``-`` where there is none."""
    return "-" if value is None else f"{value:.3g}" if value < 1000.0 else f"{value:,.0f}"


def median_ratio(numerators: Sequence[float], denominators: Sequence[float]) -> float:
    """Median of ratios of figures that were measured one right after the other."""
    return statistics.median(a / b for a, b in zip(numerators, denominators, strict=True))
