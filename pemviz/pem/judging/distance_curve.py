"""P(missed) against distance: a model, its ensemble's band, and what the data says by itself."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.arrays import FloatArray
from pemviz.pem.data.support import SupportSummary
from pemviz.pem.judging.support_check import BandSupport, support_check
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS, Pem, PemEnsemble


@dataclass(frozen=True)
class ObstacleView:
    """The obstacle whose distance varies; the braking scenario's lead car by default."""

    class_id: int = 0
    """Index into CLASS_NAMES."""
    occlusion: int = 0
    """0 none, 1 partly, 2 largely."""
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
    """Distances [m], shape [n]."""
    miss: FloatArray
    """The model's P(missed), shape [n]."""
    ensemble_low: FloatArray | None
    """2.5 % quantile over the ensemble's members, shape [n]; None without an ensemble."""
    ensemble_high: FloatArray | None
    """97.5 % quantile."""
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
    low: FloatArray | None = None
    high: FloatArray | None = None
    if ensemble is not None:
        members = np.stack([expit(-member.logit(rows)) for member in ensemble.members])
        low, high = np.quantile(members, [0.025, 0.975], axis=0)
    return DistanceCurve(
        z_m=z_m,
        miss=expit(-pem.logit(rows)),
        ensemble_low=low,
        ensemble_high=high,
        members=0 if ensemble is None else len(ensemble.members),
        bands=() if support is None else support_check(rows, support=support, pem=pem).bands,
    )
