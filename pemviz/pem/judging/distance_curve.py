"""P(missed) against distance: a model, its ensemble's band, and what the data says by itself."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table
from scipy.special import expit

from pemviz.arrays import FloatArray, IntArray
from pemviz.pem.data.support import BandSupport, SupportSummary, band_in_words, support_check
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS, Pem, PemEnsemble


@dataclass(frozen=True)
class ObstacleView:
    """The obstacle whose distance varies; the braking scenario's lead car by default."""

    class_id: int = 0
    occlusion: int = 0
    size_m: tuple[float, float, float] = (1.53, 1.63, 5.0)
    """Height, width, length [m]."""
    x_m: float = 0.0
    """Lateral offset, to the right [m]."""
    y_m: float = 1.65
    """Camera height above the obstacle's bottom [m]."""
    rotation_y_rad: float = -np.pi / 2
    """Heading; -pi/2 is away from the camera [rad]."""

    def at(self, z_m: FloatArray) -> FloatArray:
        """Salient variables [n, 11] at distances [n]."""
        rows = np.zeros((len(z_m), len(SALIENT_COLUMNS)))
        rows[:, COLUMN["class_id"]] = self.class_id
        rows[:, COLUMN["occlusion"]] = self.occlusion
        rows[:, COLUMN["alpha_rad"]] = self.rotation_y_rad - np.arctan2(self.x_m, z_m)
        rows[:, COLUMN["height_m"] : COLUMN["length_m"] + 1] = self.size_m
        rows[:, COLUMN["x_m"]] = self.x_m
        rows[:, COLUMN["y_m"]] = self.y_m
        rows[:, COLUMN["z_m"]] = z_m
        rows[:, COLUMN["rotation_y_rad"]] = self.rotation_y_rad
        return rows


@dataclass(frozen=True, eq=False)
class DistanceCurve:
    """P(missed) against distance."""

    z_m: FloatArray
    miss: FloatArray
    """The model's P(missed), shape [n]."""
    band: tuple[FloatArray, FloatArray] | None
    """2.5 and 97.5 % quantiles over the ensemble's members, shape [n]; None without one."""
    members: int
    """Members of the ensemble, 0 without one."""
    bands: tuple[BandSupport, ...]
    """The training data by distance band; empty if the model carries no counts."""


def distance_curve(
    pem: Pem,
    *,
    ensemble: PemEnsemble | None,
    support: SupportSummary | None,
    view: ObstacleView,
    z_m: FloatArray,
) -> DistanceCurve:
    """Evaluate a model, its ensemble and the data's counts over distances [n]."""
    rows = view.at(z_m)
    band: tuple[FloatArray, FloatArray] | None = None
    if ensemble is not None:
        members = np.stack([expit(-member.logit(rows)) for member in ensemble.members])
        low, high = np.quantile(members, [0.025, 0.975], axis=0)
        band = low, high
    return DistanceCurve(
        z_m=z_m,
        miss=expit(-pem.logit(rows)),
        band=band,
        members=0 if ensemble is None else len(ensemble.members),
        bands=() if support is None else support_check(rows, support=support, pem=pem).bands,
    )


def write_picture(curve: DistanceCurve, path: Path, *, title: str) -> None:
    """P(missed), on a log axis, against distance, with the data's exact 95 % intervals."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import)

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    if curve.band is not None:
        label = f"{curve.members} members, central 95 %"
        axes.fill_between(curve.z_m, *curve.band, alpha=0.25, label=label)
    axes.plot(curve.z_m, curve.miss, label="model")
    seen = [band for band in curve.bands if band.visits and band.obstacles]
    if seen:
        edges = np.asarray([_edges(band, curve) for band in seen])
        share = np.asarray([band.missed / band.obstacles for band in seen])
        low = np.asarray([band.miss_low for band in seen])
        high = np.asarray([band.miss_high for band in seen])
        axes.errorbar(
            edges.mean(axis=1),
            share,
            xerr=(edges[:, 1] - edges[:, 0]) / 2.0,
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
    if curve.band is None:
        return ""
    low, high = (ends[inside].mean() for ends in curve.band)
    return f"{low:.2g} to {high:.2g}"


def _edges(band: BandSupport, curve: DistanceCurve) -> tuple[float, float]:
    low_m = float(curve.z_m[0]) if band.low_m is None else band.low_m
    high_m = float(curve.z_m[-1]) if band.high_m is None else band.high_m
    return max(low_m, float(curve.z_m[0])), min(high_m, float(curve.z_m[-1]))
