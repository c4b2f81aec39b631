"""Averages of an error model over obstacles in bins of distance, for simulators that take tables.

P(missed) of a bin is the mean of the model's answers for the obstacles in it. Position errors have
the bin's mean and standard deviation (law of total variance): a Gaussian of these has the errors'
first two moments, not their tails.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.table import SalientTable
from pemviz.pem.judging.distance_curve import ObstacleView
from pemviz.pem.models.cards import memory_of
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.position_errors import NoiseMemory, PositionErrorModel
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN, OCCLUSION_NAMES, Pem
from pemviz.pem.models.tabulated import nearest_point_m

EDGES_M = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0, 80.0)
"""Between the bins, unless others are asked for; the first begins at 0 m."""
MOST_EDGES = 100
NARROWEST_M = 0.01
"""No bin is narrower."""
FARTHEST_M = 1000.0
"""Where the last bin ends: farther than any sensor sees."""
FIXED_TO_M = 100.0
"""The farthest obstacle of those that are averaged over where no table is given, at least."""
FIXED_IN_BIN = 40
MATCHED_LAG_S = 1.0
"""Errors so far apart have the model's correlation, where one exponential cannot have all of it."""
LONGEST_TAU_S = 60.0


@dataclass(frozen=True, eq=False)
class Obstacles:
    """What averages are over.

    Attributes:
        salient: Salient variables ``[n, 11]``.
        words: Which obstacles these are.
        detected: Whether each was, ``[n]``; ``None`` where they were made up.
        sensor_ahead_m: How far the camera is ahead of where distances begin [m].
    """

    salient: FloatArray
    words: str
    detected: BoolArray | None = None
    sensor_ahead_m: float = 0.0

    @cached_property
    def distance_m(self) -> FloatArray:
        """To the nearest point of each one's box ``[n]`` [m]."""
        return nearest_point_m(self.salient, sensor_ahead_m=self.sensor_ahead_m)

    def only(self, rows: BoolArray) -> "Obstacles":
        """Those of these rows ``[n]``."""
        detected = None if self.detected is None else self.detected[rows]
        return replace(self, salient=self.salient[rows], detected=detected)

    def at_every_occlusion(self) -> "Obstacles":
        """Each of these at each level of occlusion."""
        levels = len(OCCLUSION_NAMES)
        salient = np.tile(self.salient, (levels, 1))
        salient[:, COLUMN["occlusion"]] = np.repeat(np.arange(levels), len(self.salient))
        words = self.words.replace("not occluded", "at each level of occlusion")
        return Obstacles(salient, words, sensor_ahead_m=self.sensor_ahead_m)

    @property
    def classes(self) -> list[int]:
        """Codes of the classes that are there."""
        return np.unique(self.salient[:, COLUMN["class_id"]]).astype(int).tolist()


def table_obstacles(table: SalientTable, *, name: str, sensor_ahead_m: float) -> Obstacles:
    """All obstacles of a table, detected or missed; ``name`` is the table's."""
    words = f"{len(table)} observations of {name}, detected and missed"
    return Obstacles(table.salient, words, table.detected, sensor_ahead_m)


def fixed_obstacles(edges_m: Sequence[float], *, sensor_ahead_m: float) -> Obstacles:
    """A car straight ahead in plain view, seen from behind, equally often everywhere in a bin."""
    view = ObstacleView()
    to_m = max(FIXED_TO_M, 1.25 * max(edges_m, default=0.0))
    ends = [0.0, *edges_m, to_m]
    centres = (np.arange(FIXED_IN_BIN) + 0.5) / FIXED_IN_BIN
    nearest_m = np.concatenate([low + (high - low) * centres for low, high in pairwise(ends)])
    height, width, length = view.size_m
    words = (
        f"no table: a car straight ahead, 0 to {to_m:g} m, seen from behind, not occluded, "
        f"not truncated, {length:g} m long, {width:g} m wide, {height:g} m high"
    )
    z_m = nearest_m + 0.5 * length - sensor_ahead_m
    return Obstacles(view.at(z_m), words, sensor_ahead_m=sensor_ahead_m)


@dataclass(frozen=True, eq=False)
class AxisAverages:
    """One kind of position error by bin.

    Attributes:
        name: range, cross_range or speed.
        mean: ``[B]`` [m, m/s].
        deviation: Standard deviation ``[B]``; of tails without one, half the width of the central
            68 %.
        half_width: Half the width of the central 68 % of the model's errors ``[B]``.
        memory: How its noise hangs together over time.
        degrees_of_freedom: Of the model's Student's t; infinite for a Gaussian.
    """

    name: str
    mean: FloatArray
    deviation: FloatArray
    half_width: FloatArray
    memory: NoiseMemory
    degrees_of_freedom: float

    @property
    def tau_s(self) -> float:
        """Memory time of the first-order autoregression that stands for the noise [s]."""
        return one_memory_time(self.memory)


@dataclass(frozen=True, eq=False)
class Averages:
    """An error model of one kind of obstacle, by bins of distance.

    Attributes:
        from_m: Where each bin begins ``[B]`` [m]; the first at 0.
        rows: Obstacles in each ``[B]``.
        miss: P(missed) ``[B]``.
        memory: How misses hang together.
        axes: Kinds of position error; none without a model of them.
    """

    from_m: FloatArray
    rows: IntArray
    miss: FloatArray
    memory: Memory
    axes: tuple[AxisAverages, ...] = ()

    def bin_of(self, distance_m: FloatArray) -> IntArray:
        """Which bin distances ``[n]`` [m] are in."""
        return np.searchsorted(self.from_m, distance_m, side="right") - 1

    @property
    def bins(self) -> list[tuple[float, float]]:
        """Where each begins and ends [m]."""
        ends = [*self.from_m.tolist(), FARTHEST_M]
        return list(pairwise(ends))

    def words_of(self, where: BoolArray) -> str:
        """Bins ``[B]`` in words."""
        chosen = [ends for ends, taken in zip(self.bins, where.tolist(), strict=True) if taken]
        return ", ".join(f"{low:g} to {high:g} m" for low, high in chosen)


def one_memory_time(memory: NoiseMemory) -> float:
    """Memory time tau [s] of exp(-h / tau) that stands for a noise's correlation.

    Where nothing of the noise lasts it is the noise's own; else noises MATCHED_LAG_S apart have
    the correlation that they have.
    """
    if memory.lasting_share == 0.0:
        return min(memory.tau_s, LONGEST_TAU_S)
    correlation = float(memory.correlation(MATCHED_LAG_S))
    return min(-MATCHED_LAG_S / np.log(correlation), LONGEST_TAU_S) if correlation < 1.0 else (
        LONGEST_TAU_S
    )  # fmt: skip


def averages(
    pem: Pem,
    obstacles: Obstacles,
    *,
    edges_m: Sequence[float],
    errors: PositionErrorModel | None = None,
) -> Averages:
    """A model's averages by bin; one that has no obstacle has the next nearer one's that has.

    Raises:
        PemError: The model cannot answer for these obstacles.
    """
    from_m = np.array([0.0, *edges_m])
    place = np.searchsorted(from_m, obstacles.distance_m, side="right") - 1
    rows = np.bincount(place, minlength=len(from_m))
    held = _held(rows)

    def mean(values: FloatArray) -> FloatArray:
        sums = np.bincount(place, values, minlength=len(from_m))
        return (sums / np.maximum(rows, 1))[held]

    miss = mean(expit(-pem.logit(obstacles.salient)))
    axes: list[AxisAverages] = []
    if errors is not None:
        centre, sd, half = (
            law(obstacles.salient) for law in (errors.mean, errors.sd, errors.half_width)
        )
        for k, axis in enumerate(errors.axes):
            spread = sd if np.isfinite(axis.sd_factor) else half
            mean_m = mean(centre[:, k])
            between = (centre[:, k] - mean_m[place]) ** 2
            deviation = np.sqrt(mean(spread[:, k] ** 2 + between))
            freedom, memory = axis.degrees_of_freedom, axis.memory
            half_m = mean(half[:, k])
            axes.append(AxisAverages(axis.name, mean_m, deviation, half_m, memory, freedom))
    return Averages(from_m, rows, miss, memory_of(pem) or Memory(), tuple(axes))


def _held(rows: IntArray) -> IntArray:
    """Whose values each bin has ``[B]``: its own, or those of the next nearer one with rows."""
    filled = np.flatnonzero(rows)
    if not len(filled):
        raise PemError("no obstacle of that kind to average over")
    nearer = np.searchsorted(filled, np.arange(len(rows)), side="right") - 1
    return filled[nearer.clip(0)]


def check_edges(edges_m: Sequence[float]) -> None:
    """Whether bins may have these ends.

    Raises:
        PemError: They do not increase, or are out of range.
    """
    ends = [0.0, *edges_m, FARTHEST_M]
    increase = all(low + NARROWEST_M <= high for low, high in pairwise(ends))
    if not increase or len(edges_m) > MOST_EDGES:
        given = ",".join(f"{edge:g}" for edge in edges_m)
        raise PemError(
            f"edges_m is {given}, allowed: at most {MOST_EDGES}, at least {NARROWEST_M:g} m apart, "
            f"above 0 and below {FARTHEST_M:g}"
        )


def by_class_and_occlusion(obstacles: Obstacles) -> list[tuple[str, str, Obstacles]]:
    """Obstacles of each class and occlusion level that is there, with the names of both."""
    kind, level = (obstacles.salient[:, COLUMN[name]] for name in ("class_id", "occlusion"))
    return [
        (CLASS_NAMES[code], OCCLUSION_NAMES[occlusion], obstacles.only(rows))
        for code in obstacles.classes
        for occlusion in range(len(OCCLUSION_NAMES))
        if (rows := (kind == code) & (level == occlusion)).any()
    ]
