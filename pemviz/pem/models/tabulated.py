"""A perception error model given as a table of distance and probability.

What a table calls distance is z along the camera's axis, or, as simulators have it that take errors
by range, how far over the ground the nearest point of the obstacle's box is from one of the ego.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.files.text_files import open_text, read_numbers
from pemviz.pem.models.cards import Carded, PemCard
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.protocol import COLUMN, as_rows, check_finite, check_rows, tensors_digest

Between = Literal["linear", "step"]
Measure = Literal["ahead", "nearest-point"]

CSV_COLUMNS = ("distance_m", "p_detected")
FARTHEST_SENSOR_M = 30.0


@dataclass(frozen=True, eq=False)
class TabulatedPem(Carded):
    """P(detected) by distance; outside the table the nearest point's value holds.

    Raises:
        PemError: it is no table; one line says why.
    """

    kind: ClassVar[str] = "table"

    card: PemCard
    distance_m: FloatArray
    """Increasing distances [m], shape [points]."""
    table_logit: FloatArray
    """Logit of P(detected) at each, shape [points]."""
    between: Between = "linear"
    """Between points the logit is linear, or (step) stays what it was at the lower distance."""
    measure: Measure = "ahead"
    """Distances are z along the camera's axis, or those of :func:`nearest_point_m`."""
    sensor_ahead_m: float = 0.0
    """To the nearest point: how far the camera is ahead of where distances begin [m]."""
    tau_s: float | None = None
    """Memory time of misses [s] where the table comes with one; ``None``: the card may."""

    def __post_init__(self) -> None:
        name = self.card.name
        check_finite(self.tensors(), where=name)
        if self.distance_m.ndim != 1 or self.distance_m.shape != self.table_logit.shape:
            raise PemError(f"{name}: distances and probabilities differ in shape")
        if len(self.distance_m) == 0 or (self.distance_m[1:] <= self.distance_m[:-1]).any():
            raise PemError(f"{name}: distances must be there and increase")
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            slope = np.diff(self.table_logit) / np.diff(self.distance_m)
            extent_m = np.ptp(self.distance_m)
        if not (np.isfinite(slope).all() and np.isfinite(extent_m)):
            raise PemError(f"{name}: points so far apart that lines between them overflow")
        if self.between not in ("linear", "step"):
            raise PemError(f"{name}: between is {self.between!r}, allowed: linear, step")
        if self.measure not in ("ahead", "nearest-point"):
            raise PemError(f"{name}: measure is {self.measure!r}, allowed: ahead, nearest-point")
        check_sensor_ahead(self.sensor_ahead_m, where=name)
        if self.tau_s is not None:
            Memory(tau_s=self.tau_s)

    @property
    def memory(self) -> Memory | None:
        """How misses hang together; ``None`` where neither table nor card says."""
        return super().memory if self.tau_s is None else Memory(tau_s=self.tau_s)

    @property
    def digest(self) -> str:
        """SHA-256 of the table."""
        measured = f":{self.measure}:{self.sensor_ahead_m!r}" if self.measure != "ahead" else ""
        return tensors_digest(f"{self.kind}:{self.between}{measured}", self.tensors())

    def tensors(self) -> dict[str, AnyArray]:
        """Everything that decides the answers, by the names used in files."""
        return {"table.distance_m": self.distance_m, "table.logit": self.table_logit}

    def options(self) -> dict[str, Any]:
        """What a file must say beside the tensors."""
        rest = {
            "measure": (self.measure, "ahead"),
            "sensor_ahead_m": (self.sensor_ahead_m, 0.0),
            "tau_s": (self.tau_s, None),
        }
        said = {name: value for name, (value, default) in rest.items() if value != default}
        return {"between": self.between, **said}

    def logit(self, salient: ArrayLike) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables [..., 11]."""
        rows, shape = as_rows(salient)
        check_rows(rows)
        distance_m = rows[:, COLUMN["z_m"]]
        if self.measure == "nearest-point":
            distance_m = nearest_point_m(rows, sensor_ahead_m=self.sensor_ahead_m)
        if self.between == "step":
            index = np.searchsorted(self.distance_m, distance_m, side="right") - 1
            return self.table_logit[np.maximum(index, 0)].reshape(shape)
        return np.interp(distance_m, self.distance_m, self.table_logit).reshape(shape)


def nearest_point_m(rows: FloatArray, *, sensor_ahead_m: float = 0.0) -> FloatArray:
    """Distance over the ground to the nearest point of each obstacle's box ``[n]`` [m].

    Args:
        rows: Salient variables ``[n, 11]``.
        sensor_ahead_m: How far the camera is ahead of where distances begin, such as the rear axle.
    """
    x_m, z_m, heading = (rows[:, COLUMN[name]] for name in ("x_m", "z_m", "rotation_y_rad"))
    right_m, ahead_m = x_m, z_m + sensor_ahead_m
    # KITTI's heading turns from the right (0) away from ahead (-pi/2)
    along_m = right_m * np.cos(heading) - ahead_m * np.sin(heading)
    across_m = right_m * np.sin(heading) + ahead_m * np.cos(heading)
    beyond = [
        np.maximum(np.abs(way) - 0.5 * rows[:, COLUMN[size]], 0.0)
        for way, size in ((along_m, "length_m"), (across_m, "width_m"))
    ]
    return np.hypot(*beyond)


def check_sensor_ahead(sensor_ahead_m: float, *, where: str) -> None:
    """Whether a camera may be so far ahead of where distances begin.

    Raises:
        PemError: It is beyond FARTHEST_SENSOR_M either way, or no number.
    """
    if not abs(sensor_ahead_m) <= FARTHEST_SENSOR_M:
        limits = f"-{FARTHEST_SENSOR_M:g} to {FARTHEST_SENSOR_M:g}"
        raise PemError(f"{where}: sensor_ahead_m is {sensor_ahead_m:g}, allowed: {limits}")


def load_csv(path: Path) -> TabulatedPem:
    """Read a table with the columns distance_m and p_detected.

    Raises:
        PemError: naming file, line and what is wrong there.
    """
    if not is_file(path):
        raise PemError(f"{path}: no such file")
    with open_text(path) as stream:
        header = tuple(name.strip() for name in stream.readline().split(","))
    if header != CSV_COLUMNS:
        raise PemError(f"{path}:1: the header must be {','.join(CSV_COLUMNS)}")
    values = read_numbers(path, separator=",", columns=CSV_COLUMNS, skip_lines=1)
    probability = values[:, 1]
    if not ((probability > 0.0) & (probability < 1.0)).all():
        raise PemError(f"{path}: p_detected must lie strictly between 0 and 1 in every row")
    card = PemCard(
        name=path.stem,
        model="table",
        data=f"not stated (table {path.name})",
        licence="not stated (a table of the user's)",
        recipe="tabulated",
    )
    return TabulatedPem(card, values[:, 0], np.log(probability) - np.log1p(-probability))
