"""The rows of a benchmark table."""

import statistics
import time
from collections.abc import Callable, Sequence
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


def median_time_s(function: Callable[[], object], *, repeats: int) -> float:
    """Median wall time [s] of ``repeats`` calls, after one that is not counted."""
    function()
    times_s: list[float] = []
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        times_s.append(time.perf_counter() - began)
    return statistics.median(times_s)


def median_ratio(numerators: Sequence[float], denominators: Sequence[float]) -> float:
    """Median of ratios of figures that were measured one right after the other."""
    return statistics.median(a / b for a, b in zip(numerators, denominators, strict=True))
