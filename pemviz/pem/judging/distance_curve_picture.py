"""A distance curve as a picture and as a table for the terminal."""

from pathlib import Path

import numpy as np
from rich.table import Table

from pemviz.arrays import FloatArray, IntArray
from pemviz.pem.data.support import band_in_words
from pemviz.pem.judging.distance_curve import DistanceCurve
from pemviz.pem.judging.support_check import BandSupport


def write_picture(curve: DistanceCurve, path: Path, *, title: str) -> None:
    """P(missed), on a log axis, against distance, with the data's exact 95 % intervals."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import)

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    if curve.ensemble_low is not None and curve.ensemble_high is not None:
        axes.fill_between(
            curve.z_m,
            curve.ensemble_low,
            curve.ensemble_high,
            alpha=0.25,
            label=f"{curve.members} members, central 95 %",
        )
    axes.plot(curve.z_m, curve.miss, label="model")
    seen = [band for band in curve.bands if band.visits and band.obstacles]
    if seen:
        middle, half = _spans(seen, curve)
        share = np.asarray([band.missed / band.obstacles for band in seen])
        low = np.asarray([band.miss_low for band in seen])
        high = np.asarray([band.miss_high for band in seen])
        axes.errorbar(
            middle,
            share,
            xerr=half,
            yerr=np.stack([share - low, high - share]),
            fmt="k.",
            linewidth=0.9,
            label="training data, exact 95 %",
        )
    for band in curve.bands:
        if band.visits and not band.obstacles:
            low_m, high_m = _edges(band, curve)
            axes.axvspan(low_m, high_m, color="0.9", zorder=0)
    axes.set_yscale("log")
    axes.set_ylim(1e-4, 1.0)
    axes.set_xlim(float(curve.z_m[0]), float(curve.z_m[-1]))
    axes.set_xlabel("distance z [m] (grey: no training data)")
    axes.set_ylabel("P(missed)")
    axes.set_title(title)
    figure.legend(loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=150)


def terminal_table(curve: DistanceCurve, *, title: str) -> Table:
    """The curve by distance band (or at eleven distances, if the model carries no counts)."""
    table = Table(title=title)
    for heading in ("distance", "P(missed)", "ensemble 95 %", "data", "data alone, 95 %"):
        table.add_column(heading, justify="left" if heading == "distance" else "right")
    if not curve.bands:
        for index in np.linspace(0, len(curve.z_m) - 1, 11).astype(int):
            row = (f"z = {curve.z_m[index]:g} m", f"{curve.miss[index]:.2g}")
            table.add_row(*row, _ensemble_text(curve, np.asarray([index])), "", "")
    for band in curve.bands:
        if band.visits == 0:
            continue
        low_m, high_m = _edges(band, curve)
        inside = np.flatnonzero((curve.z_m >= low_m) & (curve.z_m <= high_m))
        table.add_row(
            band_in_words(band.index),
            f"{np.mean(curve.miss[inside]):.2g}",
            _ensemble_text(curve, inside),
            f"{band.missed} of {band.obstacles} missed" if band.obstacles else "none",
            f"{band.miss_low:.2g} to {band.miss_high:.2g}",
        )
    return table


def _ensemble_text(curve: DistanceCurve, inside: IntArray) -> str:
    if curve.ensemble_low is None or curve.ensemble_high is None:
        return ""
    low, high = curve.ensemble_low[inside].mean(), curve.ensemble_high[inside].mean()
    return f"{low:.2g} to {high:.2g}"


def _edges(band: BandSupport, curve: DistanceCurve) -> tuple[float, float]:
    low_m = float(curve.z_m[0]) if band.low_m is None else band.low_m
    high_m = float(curve.z_m[-1]) if band.high_m is None else band.high_m
    return max(low_m, float(curve.z_m[0])), min(high_m, float(curve.z_m[-1]))


def _spans(bands: list[BandSupport], curve: DistanceCurve) -> tuple[FloatArray, FloatArray]:
    edges = np.asarray([_edges(band, curve) for band in bands])
    return edges.mean(axis=1), (edges[:, 1] - edges[:, 0]) / 2.0
