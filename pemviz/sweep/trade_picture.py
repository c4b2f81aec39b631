"""The picture of a trade: a point a setting, one rule to the right and the other upwards."""

import io
from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from pemviz.colors import BLUE, GREY, ORANGE
from pemviz.sweep.trade import ON_FRONT, Standing, Trade, TradePoint, is_known

STYLES: Mapping[str, tuple[tuple[Standing, ...], str, str]] = {
    "not dominated": (ON_FRONT, BLUE, "o"),
    "perhaps dominated": (("perhaps dominated",), ORANGE, "s"),
    "dominated": (("dominated",), GREY, "x"),
}
"""Standings, colour and mark: told apart without colour, too."""
MOST_NAMED = 12


def trade_png(trade: Trade) -> bytes | None:
    """The picture as PNG; ``None`` where no setting is known in both rules."""
    known = [point for point in trade.points if is_known(point.first) and is_known(point.second)]
    if not known:
        return None
    figure = Figure(figsize=(8.0, 5.6), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    for words, (standings, color, mark) in STYLES.items():
        points = [point for point in known if point.standing in standings]
        if points:
            _draw(axes, points, color=color, mark=mark, label=f"{words} ({len(points)})")
    _name(axes, [point for point in known if point.standing in ON_FRONT])
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(f"P({trade.rules[0]} broken)")
    axes.set_ylabel(f"P({trade.rules[1]} broken)")
    axes.set_title("Better is to the left and down; bars: 95 % intervals of sampling", loc="left")
    axes.grid(visible=True, which="major", color="#e4e7eb")
    axes.set_axisbelow(True)
    figure.legend(loc="outside lower left", ncols=3, frameon=False, fontsize=9)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    return picture.getvalue()


def _draw(axes: Any, points: list[TradePoint], *, color: str, mark: str, label: str) -> None:
    ends: list[list[list[float]]] = [[[], []], [[], []]]
    places: list[list[float]] = [[], []]
    for point in points:
        for axis, estimate in enumerate((point.first, point.second)):
            if estimate is None or estimate.ci_low is None or estimate.ci_high is None:
                continue
            places[axis].append(estimate.probability)
            ends[axis][0].append(estimate.probability - estimate.ci_low)
            ends[axis][1].append(estimate.ci_high - estimate.probability)
    axes.errorbar(
        *places, xerr=ends[0], yerr=ends[1], fmt=mark, color=color, markersize=7,
        elinewidth=1.0, capsize=2.5, alpha=0.9, label=label,
    )  # fmt: skip


def _name(axes: Any, points: list[TradePoint]) -> None:
    """Names beside the settings on the front, above and below by turns."""
    ranked = sorted(points, key=lambda one: one.first.probability if one.first else 0.0)
    for number, point in enumerate(ranked[:MOST_NAMED]):
        if point.first is None or point.second is None:
            continue
        axes.annotate(
            point.name, (point.first.probability, point.second.probability), fontsize=9,
            xytext=(7, 8 if number % 2 == 0 else -14), textcoords="offset points",
        )  # fmt: skip
