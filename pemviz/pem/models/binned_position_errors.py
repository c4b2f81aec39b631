"""Position errors given as a table by distance, as simulators have it that take errors by range.

In a bin of distance each kind of error has one mean and one standard deviation and is Gaussian; how
its noise hangs together over time is that of any model of position errors. Distances are those of
:func:`pemviz.pem.models.tabulated.nearest_point_m`, and the last bin reaches as far as one likes.
"""

from dataclasses import dataclass, field, fields
from typing import Self

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import PemError
from pemviz.pem.models.position_errors import GAUSSIAN, PositionErrorModel
from pemviz.pem.models.protocol import as_rows
from pemviz.pem.models.tabulated import check_sensor_ahead, nearest_point_m

BINS, BIN_MEANS, BIN_DEVIATIONS, BIN_SENSOR = (
    *("bins.from_m", "bins.mean", "bins.deviation", "bins.sensor_ahead_m"),
)
"""Names of the tensors of a file that other models of position errors have not."""


def _none() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class BinnedPositionErrors(PositionErrorModel):
    """Gaussian errors by distance; axes and correlation say how their noise hangs together.

    Attributes:
        from_m: Where each bin begins ``[B]`` [m], increasing from 0.
        bin_mean: Mean of each kind of error ``[B, M]`` [m, m/s].
        bin_deviation: Its standard deviation ``[B, M]`` [m, m/s].
        sensor_ahead_m: How far the camera is ahead of where distances begin [m].

    Raises:
        PemError: A parameter has another shape, or is out of range.
    """

    from_m: FloatArray = field(default_factory=_none)
    bin_mean: FloatArray = field(default_factory=_none)
    bin_deviation: FloatArray = field(default_factory=_none)
    sensor_ahead_m: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = (len(self.from_m), len(self.axes))
        if self.from_m.ndim != 1 or not len(self.from_m) or self.from_m[0] != 0.0:
            raise PemError("bins must be there and begin at 0 m")
        if not (np.isfinite(self.from_m).all() and (np.diff(self.from_m) > 0.0).all()):
            raise PemError("bins must begin farther and farther away")
        if self.bin_mean.shape != shape or self.bin_deviation.shape != shape:
            raise PemError(f"means and deviations by bin must have shape {list(shape)}")
        if not (np.isfinite(self.bin_mean).all() and np.isfinite(self.bin_deviation).all()):
            raise PemError("means and deviations by bin must be finite")
        if (self.bin_deviation < 0.0).any():
            raise PemError("deviations by bin must be 0 or more")
        if any(axis.degrees_of_freedom != GAUSSIAN for axis in self.axes):
            raise PemError("errors by bin are Gaussian: degrees of freedom must be infinite")
        check_sensor_ahead(self.sensor_ahead_m, where="bins")

    @classmethod
    def of(
        cls,
        model: PositionErrorModel,
        from_m: FloatArray,
        bin_mean: FloatArray,
        bin_deviation: FloatArray,
        sensor_ahead_m: FloatArray,
    ) -> Self:
        """The errors by bin whose noise hangs together as that of ``model``."""
        given = {one.name: getattr(model, one.name) for one in fields(PositionErrorModel)}
        return cls(
            **given,
            from_m=from_m,
            bin_mean=bin_mean,
            bin_deviation=bin_deviation,
            sensor_ahead_m=float(sensor_ahead_m[0]),
        )

    def mean(self, salient: FloatArray) -> FloatArray:
        """Mean of the errors ``[N, M]`` [m, m/s] for salient variables ``[N, 11]``."""
        return self.bin_mean[self._bin(salient)]

    def scale(self, salient: FloatArray) -> FloatArray:
        """Standard deviation of the errors ``[N, M]`` [m, m/s]."""
        return self.bin_deviation[self._bin(salient)]

    def tensors(self) -> dict[str, AnyArray]:
        """The parameters by name, as they are stored."""
        return {
            **super().tensors(),
            BINS: self.from_m,
            BIN_MEANS: self.bin_mean,
            BIN_DEVIATIONS: self.bin_deviation,
            BIN_SENSOR: np.array([self.sensor_ahead_m]),
        }

    def _bin(self, salient: FloatArray) -> AnyArray:
        rows, _ = as_rows(salient)
        distance_m = nearest_point_m(rows, sensor_ahead_m=self.sensor_ahead_m)
        return np.searchsorted(self.from_m, distance_m, side="right") - 1
