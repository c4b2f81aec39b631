"""Position errors drawn along the tracks of detected obstacles, and the largest of each track.

The noise of a track is that of :class:`~pemviz.pem.models.position_errors.NoiseMemory`, in the
variants of a predictive check: independent from step to step; forgetful alone, with its memory
time; lasting alone, an obstacle's own share; and both, beside a visibility that comes and goes too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.position_errors import RANGE, PositionErrorTable
from pemviz.pem.data.table import rows_by_place
from pemviz.pem.fitting import position_errors as fitting
from pemviz.pem.models.memory import persistence
from pemviz.pem.models.position_errors import (
    INDEPENDENT,
    ErrorAxis,
    PositionErrorModel,
    features,
    standard_quantile,
)
from pemviz.pem.models.predictive_check import POSITION_QUANTITIES, QuantityName, Variant

NOISE_GRID = np.linspace(-9.0, 9.0, 3601)
"""Between these points quantiles of errors are interpolated: a draw needs no more digits."""
DIGITS = 9

Values = dict[QuantityName, FloatArray]


@dataclass(frozen=True, eq=False)
class ErrorLaw:
    """What errors along the line of sight are drawn from, and those that were observed.

    Rows are ordered by track and time.

    Attributes:
        error: As observed ``[n]`` [m].
        track: Which obstacle ``[n]``.
        time_s: When ``[n]`` [s].
        part: Which axis tells of each row ``[n]``.
        axes: The laws.
        mean: Of each row ``[n]`` [m].
        scale: Likewise [m].
    """

    error: FloatArray
    track: IntArray
    time_s: FloatArray
    part: IntArray
    axes: Sequence[ErrorAxis]
    mean: FloatArray
    scale: FloatArray

    @cached_property
    def _starts(self) -> IntArray:
        return np.flatnonzero(np.diff(self.track, prepend=-1) != 0)

    def observed(self) -> Values:
        """The quantities of the observed errors ``[1]`` [m]."""
        return self._values(self.error[None])

    def drawn(self, variant: Variant, *, count: int, random: np.random.Generator) -> Values:
        """The quantities of drawn errors ``[count]`` [m]; one by one, so that each stays itself."""
        noise = np.stack([self._noise(variant, random) for _ in range(count)])
        standard = np.empty_like(noise)
        for place, axis in enumerate(self.axes):
            rows = self.part == place
            curve = standard_quantile(NOISE_GRID, degrees_of_freedom=axis.degrees_of_freedom)
            standard[:, rows] = np.interp(noise[:, rows], NOISE_GRID, curve)
        return self._values(self.mean + self.scale * standard)

    def _values(self, errors: FloatArray) -> Values:
        largest = np.maximum.reduceat(np.abs(errors), self._starts, axis=1)
        values = (largest.mean(axis=1), largest.max(axis=1))
        return {
            name: np.round(value, DIGITS)
            for name, value in zip(POSITION_QUANTITIES, values, strict=True)
        }

    def _noise(self, variant: Variant, random: np.random.Generator) -> FloatArray:
        """Standard normals ``[n]`` that hang together along tracks as the variant says."""
        share, rho = self._hanging_together(variant)
        lasting = random.standard_normal(self._starts.size)
        fresh = random.standard_normal(self.error.size)
        sizes = np.diff(np.append(self._starts, self.error.size))
        forgetful = fresh.copy()
        for rows in self._later:
            kept = rho[rows]
            forgetful[rows] = kept * forgetful[rows - 1] + np.sqrt(1.0 - kept**2) * fresh[rows]
        return np.sqrt(share) * np.repeat(lasting, sizes) + np.sqrt(1.0 - share) * forgetful

    @cached_property
    def _later(self) -> list[IntArray]:
        return rows_by_place(self._starts, count=self.error.size)[1:]

    def _hanging_together(self, variant: Variant) -> tuple[FloatArray, FloatArray]:
        """Lasting share, and correlation of the rest with the row before, of each row ``[n]``."""
        of_parts = [axis.memory for axis in self.axes]
        share = np.array([one.lasting_share for one in of_parts])[self.part]
        since_s = np.diff(self.time_s, prepend=0.0)
        rho = np.zeros(self.error.size)
        for place, memory in enumerate(of_parts):
            rows = self.part == place
            rho[rows] = persistence(np.maximum(since_s[rows], 0.0), memory.tau_s)
        return (
            share if variant in ("frailty", "both", "visibility") else np.zeros_like(share),
            rho if variant in ("memory", "both", "visibility") else np.zeros_like(rho),
        )


def law_of_model(table: PositionErrorTable, model: PositionErrorModel) -> ErrorLaw:
    """Errors of a table by a model that was fitted elsewhere.

    Raises:
        PemError: The table does not tell tracks and times.
    """
    part = np.zeros(len(table), dtype=np.int64)
    ends = (model.distance_m, model.bearing_rad)
    return _law(table, part, [model.axes[0]], [ends])


def cross_fitted_law(
    table: PositionErrorTable,
    *,
    seed: int = 0,
    on_progress: Callable[[int, int], None] | None = None,
) -> ErrorLaw:
    """Errors of a table, those of each part of the drives by a model of the others.

    ``on_progress`` is called with parts done and parts in all.

    Raises:
        PemError: There are too few rows or drives, or the table tells no tracks and times.
    """
    groups = np.unique(table.groups[1], return_inverse=True)[1].astype(np.int64)
    part = fitting.group_folds(groups)
    axes: list[ErrorAxis] = []
    ends: list[tuple[tuple[float, float], tuple[float, float]]] = []
    for each in range(fitting.FOLDS):
        rest = table.only(part != each)
        explained = fitting.error_features(rest)
        error = rest.errors[:, table.axes.index(RANGE)]
        fit = partial(fitting.fit_axis, explained, error, name=RANGE)
        axis = min(
            (fit(heavy=False), fit(heavy=True)),
            key=lambda one: float(fitting.error_nats(one, explained, error).mean()),
        )
        noise = fitting.normal_scores(axis, explained, error)
        memory = fitting.fit_noise_memory(
            noise, fitting.lag_pairs(rest), groups=groups[part != each], seed=seed
        )
        axes.append(replace(axis, memory=INDEPENDENT if memory is None else memory.memory))
        ends.append((explained.distance_m, explained.bearing_rad))
        if on_progress is not None:
            on_progress(each + 1, fitting.FOLDS)
    return _law(table, part, axes, ends)


def _law(
    table: PositionErrorTable,
    part: IntArray,
    axes: Sequence[ErrorAxis],
    ends: Sequence[tuple[tuple[float, float], tuple[float, float]]],
) -> ErrorLaw:
    if table.track is None or table.time_s is None:
        raise PemError(f"{table.source}: position errors need track, frame and the rate of frames")
    mean, scale = np.empty(len(table)), np.empty(len(table))
    for place, (axis, (distance_m, bearing_rad)) in enumerate(zip(axes, ends, strict=True)):
        rows = part == place
        of_mean, of_scale = features(
            distance_m=table.distance_m[rows].clip(*distance_m),
            bearing_rad=np.arctan2(table.x_m, table.z_m)[rows].clip(*bearing_rad),
            alpha_rad=None if table.alpha_rad is None else table.alpha_rad[rows],
        )
        mean[rows], scale[rows] = of_mean @ axis.mean, np.exp(of_scale @ axis.log_scale)
    order = np.lexsort((table.time_s, table.track))
    return ErrorLaw(
        error=table.errors[order, table.axes.index(RANGE)],
        track=table.track[order],
        time_s=table.time_s[order],
        part=part[order],
        axes=axes,
        mean=mean[order],
        scale=scale[order],
    )
