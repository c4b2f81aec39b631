"""Axes of powers of ten, as every engine takes them."""

import math

from pemviz.charts.chart import IntervalChart

FARTHEST = -40.0
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
