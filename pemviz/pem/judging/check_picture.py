"""The picture of predictive checks: what was observed beside what each variant draws."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.colors import BLACK, GREEN, GREY, ORANGE, SKY, VERMILLION
from pemviz.pem.judging.predictive_check import CURVE_MISSES, CURVE_S, Checked
from pemviz.pem.models.predictive_check import (
    AFTER_HIT,
    AFTER_MISS,
    CLOSE_M,
    DISTANCE_BANDS_M,
    VARIANT_WORDS,
    CheckedQuantity,
    QuantityName,
    Variant,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ENDS = (2.5, 97.5)


@dataclass(frozen=True)
class Style:
    """Colour, line and mark of a variant: told apart without colour, too."""

    color: str
    line: str
    mark: str


STYLES: dict[Variant, Style] = {
    "independent": Style(GREY, ":", "o"),
    "memory": Style(SKY, "--", "^"),
    "frailty": Style(ORANGE, "-.", "v"),
    "both": Style(VERMILLION, "-", "D"),
    "visibility": Style(GREEN, "--", "P"),
}


BANDED: tuple[Variant, ...] = ("independent", "both")
"""Variants whose curves have bands: those of all would hide each other."""


def write_check_picture(checked: Checked, path: Path, *, title: str) -> None:
    """Six charts as PNG: runs, misses close by, after a miss and a hit, distances, positions."""
    # slow to import
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.ticker import NullFormatter, ScalarFormatter  # noqa: PLC0415

    figure = Figure(figsize=(14.0, 8.2), layout="constrained")
    ((runs, misses, first), (after_miss, after_hit, errors)) = figure.subplots(2, 3)
    _draw_curve(runs, checked, "runs", CURVE_S)
    runs.set_xlabel("missed for so long at a time, or longer [s]")
    runs.set_ylabel("share of tracks")
    runs.set_title("Longest run of misses of a track")
    _draw_curve(misses, checked, "misses", CURVE_MISSES)
    misses.set_xlabel(f"misses within {CLOSE_M:g} m on approach, or more")
    misses.set_ylabel("share of tracks that come there")
    misses.set_title("Misses close by")
    for axes, names, after in ((after_miss, AFTER_MISS, "miss"), (after_hit, AFTER_HIT, "hit")):
        bands = [f"{low:g}\N{EN DASH}{high:g}" for low, high in DISTANCE_BANDS_M]
        _draw_points(axes, checked, list(zip(names, ("all", *bands), strict=True)))
        axes.set_xlabel("distance [m]")
        axes.set_ylabel("share missed")
        axes.set_ylim(bottom=0.0)
        axes.set_title(f"Misses after a {after}")
    _draw_points(first, checked, [("first_m", "first"), ("lasting_m", "lastingly")])
    first.set_ylabel("distance, mean of tracks [m]")
    first.set_title("Where an approaching track is detected")
    named: list[tuple[QuantityName, str]] = [
        ("largest_error_m", "of a track, mean"),
        ("largest_of_all_m", "of all tracks"),
    ]
    if _draw_points(errors, checked, named):
        errors.set_yscale("log")
        errors.yaxis.set_major_formatter(ScalarFormatter())
        errors.yaxis.set_minor_formatter(NullFormatter())
    errors.set_ylabel("error along the line of sight [m]")
    errors.set_title("Largest position error")
    shown, labels = runs.get_legend_handles_labels()
    figure.legend(shown, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    check = checked.check
    words = f"{check.tracks:,} tracks, {check.sequences} sequences; bands and bars: 95 % of draws"
    figure.suptitle(f"{title}: {words}")
    figure.savefig(path, dpi=110)


def _draw_curve(
    axes: "Axes", checked: Checked, name: Literal["runs", "misses"], points: FloatArray
) -> None:
    """Shares of tracks with at least so much, on a logarithmic scale."""
    observed = checked.observed.curves.get(name)
    if observed is None:
        _draw_nothing(axes)
        return
    tracks = checked.check.tracks if name == "runs" else checked.check.approaching
    least = 0.5 / tracks
    for variant, drawn in checked.drawn.items():
        style = STYLES[variant]
        if variant in BANDED:
            ends = np.percentile(drawn.curves[name], ENDS, axis=0)
            low, high = np.maximum(ends, least / 2.0)
            axes.fill_between(points, low, high, color=style.color, alpha=0.2, linewidth=0.0)
        mean = drawn.curves[name].mean(axis=0)
        axes.plot(
            points, np.where(mean > 0.0, mean, np.nan), style.line, color=style.color,
            linewidth=1.8, marker=style.mark, markersize=5, markevery=4,
            label=VARIANT_WORDS[variant],
        )  # fmt: skip
    seen = np.where(observed[0] > 0.0, observed[0], np.nan)
    axes.plot(points, seen, "s-", color=BLACK, markersize=3.5, linewidth=1.2, label="observed")
    axes.set_yscale("log")
    axes.set_ylim(least, 1.0)
    axes.grid(alpha=0.25)


def _draw_points(axes: "Axes", checked: Checked, names: Sequence[tuple[QuantityName, str]]) -> bool:
    """Quantities beside each other, each with its mean and the middle 95 % of each variant.

    Gives whether the table has any of them.
    """
    variants = checked.check.variants
    known = {one.name for one in variants[0].quantities}
    shown = [(name, words) for name, words in names if name in known]
    if not shown:
        _draw_nothing(axes)
        return False
    for place, variant in enumerate(variants):
        style = STYLES[variant.name]
        by_name = {one.name: one for one in variant.quantities}
        offset = 0.14 * (place - (len(variants) - 1) / 2.0)
        rows = [by_name[name] for name, _ in shown]
        x = [at + offset for at, one in enumerate(rows) if one.expected is not None]
        middle, below, above = _ends([one for one in rows if one.expected is not None])
        axes.errorbar(
            x,
            middle,
            yerr=(below, above),
            fmt=style.mark,
            color=style.color,
            capsize=3,
            markersize=5,
        )
    observed = {one.name: one.observed for one in variants[0].quantities}
    for at, (name, _) in enumerate(shown):
        value = observed[name]
        if value is not None:
            axes.plot([at - 0.36, at + 0.36], [value, value], "-", color=BLACK, linewidth=2.0)
    axes.set_xticks(range(len(shown)), [words for _, words in shown])
    axes.set_xlim(-0.5, len(shown) - 0.5)
    axes.grid(axis="y", alpha=0.25)
    return True


def _ends(rows: Sequence[CheckedQuantity]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means, and how far the middle 95 % reach below and above ``[k]`` each."""
    values = [(one.expected, one.low, one.high) for one in rows]
    middle, low, high = np.array(values, dtype=np.float64).reshape(-1, 3).T
    return middle, np.maximum(middle - low, 0.0), np.maximum(high - middle, 0.0)


def _draw_nothing(axes: "Axes") -> None:
    axes.text(
        0.5,
        0.5,
        "not in this table",
        ha="center",
        va="center",
        color=GREY,
        transform=axes.transAxes,
    )
    axes.set_xticks([])
    axes.set_yticks([])
