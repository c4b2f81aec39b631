"""Position errors: where perception says that a detected obstacle is, by distance and bearing.

For each kind of error (along the line of sight, across it, of speed)::

    error = mean(s) + scale(s) Q(u)          Q(u) = F^-1(Phi(u))

with u standard normal, F the standard normal distribution (Q(u) = u) or Student's t with nu
degrees of freedom, chosen by held-out likelihood. mean and log scale are linear in few features of
the state s, with d the distance, b = atan2(x, z) the bearing, alpha KITTI's observation angle and
l = log(d / 20 m)::

    mean       1, l, sin b, 1 - cos b
    log scale  1, l, l^2, sin b, 1 - cos b, cos 2 alpha

cos 2 alpha is -1 where the obstacle is seen from its front or back, 1 from its side. Beyond the
distances and bearings of the training data both stay what they are at the ends of these.

The u of one obstacle hang together: across kinds of error by a correlation matrix, and over time,
``h`` seconds apart, by ``c + (1 - c) exp(-h / tau)``: a share c that an obstacle keeps for as long
as it is there, and a rest that is forgotten with a memory time tau (a first-order autoregression).
"""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.special import ndtr, stdtrit

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import PemError
from pemviz.pem.models.cards import PositionErrorCard
from pemviz.pem.models.memory import persistence
from pemviz.pem.models.protocol import COLUMN, as_rows

REFERENCE_M = 20.0
MEAN_FEATURES = ("1", "log(d / 20 m)", "sin b", "1 - cos b")
SCALE_FEATURES = ("1", "log(d / 20 m)", "log(d / 20 m)^2", "sin b", "1 - cos b", "cos 2 alpha")
GAUSSIAN = np.inf
"""Degrees of freedom of a Gaussian."""
FARTHEST_NOISE = 20.0
"""Noise beyond +-20 counts as that: a standard normal is there with a probability of 6e-89."""


@dataclass(frozen=True)
class NoiseMemory:
    """How the noise of one obstacle hangs together over time.

    Attributes:
        lasting_share: Share c of its variance that an obstacle keeps, 0 to 1.
        tau_s: Memory time of the rest [s]; 0: steps are independent.

    Raises:
        PemError: A value is out of range.
    """

    lasting_share: float = 0.0
    tau_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.lasting_share <= 1.0:
            raise PemError(f"lasting_share is {self.lasting_share:g}, allowed: 0 to 1")
        if not 0.0 <= self.tau_s < np.inf:
            raise PemError(f"tau_s is {self.tau_s:g}, allowed: 0 or more, and finite")

    def correlation(self, since_s: FloatArray | float) -> FloatArray:
        """Of noises so many seconds apart, elementwise ``[...]``."""
        return self.lasting_share + (1.0 - self.lasting_share) * self._forgotten(since_s)

    def after(self, before: FloatArray, fresh: FloatArray, *, since_s: float) -> FloatArray:
        """The forgetful part of the noise ``[N]``, ``since_s`` seconds after ``before [N]``.

        Standard normal if that and ``fresh [N]`` are.
        """
        rho = float(self._forgotten(since_s))
        return rho * before + np.sqrt(1.0 - rho**2) * fresh

    def noise(self, lasting: FloatArray, forgetful: FloatArray) -> FloatArray:
        """The noise of an error ``[...]`` from its two parts, each standard normal ``[...]``."""
        share = self.lasting_share
        return np.sqrt(share) * lasting + np.sqrt(1.0 - share) * forgetful

    def _forgotten(self, since_s: FloatArray | float) -> FloatArray:
        return np.where(np.equal(since_s, 0.0), 1.0, persistence(since_s, self.tau_s))


INDEPENDENT = NoiseMemory()


@dataclass(frozen=True, eq=False)
class ErrorAxis:
    """One kind of error.

    Attributes:
        name: range, cross_range or speed.
        mean: Coefficients of MEAN_FEATURES ``[4]`` [m, or m/s].
        log_scale: Coefficients of SCALE_FEATURES ``[6]``; a first one of -inf: no spread.
        degrees_of_freedom: Degrees of freedom of Student's t; infinite for a Gaussian.
        memory: How its noise hangs together over time.
    """

    name: str
    mean: FloatArray
    log_scale: FloatArray
    degrees_of_freedom: float = GAUSSIAN
    memory: NoiseMemory = INDEPENDENT

    @property
    def sd_factor(self) -> float:
        """Standard deviation over scale; infinite where the tails are too heavy to have one."""
        nu = self.degrees_of_freedom
        if np.isinf(nu):
            return 1.0
        return float(np.sqrt(nu / (nu - 2.0))) if nu > 2.0 else np.inf

    @property
    def half_width_factor(self) -> float:
        """Half the width of the central 68 % over scale."""
        one = standard_quantile(np.ones(1), degrees_of_freedom=self.degrees_of_freedom)
        return float(one[0])


@dataclass(frozen=True, eq=False)
class PositionErrorModel:
    """Errors of the reported positions of detected obstacles; see the module for the formula.

    Attributes:
        axes: The M kinds of error, in this order: range, cross_range, and perhaps speed.
        correlation: Of the noises of different kinds in one frame ``[M, M]``.
        distance_m: Least and greatest distance of the training data [m].
        bearing_rad: Least and greatest bearing of the training data [rad].
        card: Name, data, licence, and how well it fits.

    Raises:
        PemError: A parameter has another shape, or is out of range.
    """

    axes: tuple[ErrorAxis, ...]
    correlation: FloatArray
    distance_m: tuple[float, float] = (0.1, 1e4)
    bearing_rad: tuple[float, float] = (-np.pi, np.pi)
    card: PositionErrorCard = field(default_factory=PositionErrorCard)

    def __post_init__(self) -> None:
        _check_parameters(self)

    @property
    def name(self) -> str:
        """Short name."""
        return self.card.name

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of the parameters."""
        digest = hashlib.sha256()
        for name, array in sorted(self.tensors().items()):
            digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def error(self, salient: FloatArray, noise: FloatArray) -> FloatArray:
        """Errors, reported minus true ``[N, M]``: [m] along and across the line of sight, [m/s].

        Above 0: reported too far away, too far to the right, too fast.

        Args:
            salient: Salient variables ``[N, 11]``, see ``pemviz.pem.SALIENT_COLUMNS``.
            noise: Independent standard normals ``[N, M]``; those of one obstacle hang together
                over time if they come from :class:`NoiseMemory`.

        Raises:
            PemError: A shape is another.
        """
        rows, shape = as_rows(salient)
        if np.shape(noise) != (*shape, len(self.axes)):
            raise PemError(
                f"noise has shape {list(np.shape(noise))}, need {[*shape, len(self.axes)]}"
            )
        independent = np.asarray(noise, dtype=np.float64).reshape(-1, len(self.axes))
        mixed = np.stack(
            [sum_in_order(row, independent) for row in np.linalg.cholesky(self.correlation)], axis=1
        )
        standard = np.stack(
            [standard_quantile(mixed[:, place], degrees_of_freedom=axis.degrees_of_freedom)
             for place, axis in enumerate(self.axes)], axis=1
        )  # fmt: skip
        return (self.mean(rows) + self.scale(rows) * standard).reshape(*shape, -1)

    def range_error(self, salient: FloatArray, noise: FloatArray) -> FloatArray:
        """Errors along the line of sight alone ``[N]`` [m], of standard normals ``[N]``.

        The same as the first column of :meth:`error`, from one noise an obstacle.

        Raises:
            PemError: A shape is another.
        """
        rows, shape = as_rows(salient)
        if np.shape(noise) != shape:
            raise PemError(f"noise has shape {list(np.shape(noise))}, need {list(shape)}")
        standard = standard_quantile(
            np.reshape(noise, -1), degrees_of_freedom=self.axes[0].degrees_of_freedom
        )
        return (self.mean(rows)[:, 0] + self.scale(rows)[:, 0] * standard).reshape(shape)

    @property
    def range_memory(self) -> NoiseMemory:
        """How the noise along the line of sight hangs together over time."""
        return self.axes[0].memory

    def mean(self, salient: FloatArray) -> FloatArray:
        """Centre of the errors ``[N, M]`` [m, m/s] for salient variables ``[N, 11]``."""
        features = self._features(salient)[0]
        return np.stack([sum_in_order(axis.mean, features) for axis in self.axes], axis=1)

    def scale(self, salient: FloatArray) -> FloatArray:
        """Scale of the errors ``[N, M]`` [m, m/s]: half the width of the central 68 % or less."""
        features = self._features(salient)[1]
        logs = [sum_in_order(axis.log_scale, features) for axis in self.axes]
        return np.exp(np.stack(logs, axis=1))

    def sd(self, salient: FloatArray) -> FloatArray:
        """Standard deviation of the errors ``[N, M]`` [m, m/s]; infinite if there is none."""
        return self.scale(salient) * np.array([axis.sd_factor for axis in self.axes])

    def half_width(self, salient: FloatArray) -> FloatArray:
        """Half the width of the central 68 % of the errors ``[N, M]`` [m, m/s]."""
        return self.scale(salient) * np.array([axis.half_width_factor for axis in self.axes])

    def tensors(self) -> dict[str, AnyArray]:
        """The parameters by name, as they are stored."""
        of_axes = {
            f"{axis.name}.{part}": values
            for axis in self.axes
            for part, values in (
                ("mean", axis.mean),
                ("log_scale", axis.log_scale),
                ("tail", np.array([axis.degrees_of_freedom])),
                ("memory", np.array([axis.memory.lasting_share, axis.memory.tau_s])),
            )
        }
        ends = np.array([self.distance_m, self.bearing_rad])
        return {**of_axes, "correlation": self.correlation, "ends": ends}

    def _features(self, salient: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows, _ = as_rows(salient)
        x_m, z_m = rows[:, COLUMN["x_m"]], rows[:, COLUMN["z_m"]]
        return features(
            distance_m=np.hypot(x_m, z_m).clip(*self.distance_m),
            bearing_rad=np.arctan2(x_m, z_m).clip(*self.bearing_rad),
            alpha_rad=rows[:, COLUMN["alpha_rad"]],
        )


def constant_errors(
    *, range_sd_m: float = 0.0, cross_range_sd_m: float = 0.0, memory: NoiseMemory = INDEPENDENT
) -> PositionErrorModel:
    """Gaussian errors without bias, equal wherever the obstacle is; a deviation of 0: none.

    Raises:
        PemError: A deviation is below 0 or not finite.
    """
    deviations = {"range": range_sd_m, "cross_range": cross_range_sd_m}
    for name, sd_m in deviations.items():
        if not 0.0 <= sd_m < np.inf:
            raise PemError(f"{name}_sd_m is {sd_m:g}, allowed: 0 or more, and finite")
    with np.errstate(divide="ignore"):
        axes = tuple(
            ErrorAxis(name, np.zeros(len(MEAN_FEATURES)),
                      np.append(np.log(sd_m), np.zeros(len(SCALE_FEATURES) - 1)), memory=memory)
            for name, sd_m in deviations.items()
        )  # fmt: skip
    return PositionErrorModel(axes, np.eye(2), card=PositionErrorCard(name="constant"))


def standard_quantile(noise: FloatArray, *, degrees_of_freedom: float) -> FloatArray:
    """Q(u) = F^-1(Phi(u)), elementwise ``[...]``, F Student's t with so many degrees of freedom.

    Args:
        noise: u, standard normal ``[...]``; beyond +-FARTHEST_NOISE it counts as that.
        degrees_of_freedom: Above 0; infinite: F is the standard normal distribution.
    """
    within = np.clip(noise, -FARTHEST_NOISE, FARTHEST_NOISE)
    if np.isinf(degrees_of_freedom):
        return within
    # the lower tail's digits stay, those of 1 - p would not
    return -np.sign(within) * stdtrit(degrees_of_freedom, ndtr(-np.abs(within)))


def features(
    *, distance_m: FloatArray, bearing_rad: FloatArray, alpha_rad: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """MEAN_FEATURES ``[n, 4]`` and SCALE_FEATURES ``[n, 6]``.

    Args:
        distance_m: ``[n]`` [m].
        bearing_rad: ``[n]`` [rad], above 0 to the right.
        alpha_rad: Observation angle ``[n]`` [rad]; ``None``: unknown, and without influence.
    """
    log_distance = np.log(distance_m / REFERENCE_M)
    one, side, turned = np.ones_like(log_distance), np.sin(bearing_rad), 1.0 - np.cos(bearing_rad)
    aspect = np.zeros_like(one) if alpha_rad is None else np.cos(2.0 * alpha_rad)
    of_mean = np.stack([one, log_distance, side, turned], axis=1)
    of_scale = np.stack([one, log_distance, log_distance**2, side, turned, aspect], axis=1)
    return of_mean, of_scale


def sum_in_order(coefficients: FloatArray, columns: FloatArray) -> FloatArray:
    """Linear combination ``[n]`` of columns ``[n, k]``, the same in a batch of any size.

    A coefficient of 0 leaves its column out, be it infinite.
    """
    total = np.zeros(len(columns))
    for coefficient, column in zip(coefficients.tolist(), columns.T, strict=True):
        if coefficient != 0.0:
            total = total + coefficient * column
    return total


def _check_parameters(model: PositionErrorModel) -> None:
    names = tuple(axis.name for axis in model.axes)
    if names not in (("range", "cross_range"), ("range", "cross_range", "speed")):
        raise PemError(f"kinds of error are {names}, must be range, cross_range and perhaps speed")
    count = len(names)
    for axis in model.axes:
        shapes = (np.shape(axis.mean), np.shape(axis.log_scale))
        if shapes != ((len(MEAN_FEATURES),), (len(SCALE_FEATURES),)):
            raise PemError(f"{axis.name}: coefficients have shapes {shapes}")
        rest = (*axis.mean.tolist(), *axis.log_scale[1:].tolist())
        if not np.isfinite(rest).all() or not axis.log_scale[0] < np.inf:
            raise PemError(f"{axis.name}: coefficients must be finite")
        if not axis.degrees_of_freedom >= 1.0:
            raise PemError(
                f"{axis.name}: degrees of freedom are {axis.degrees_of_freedom:g}, must be >= 1"
            )
    matrix = model.correlation
    if np.shape(matrix) != (count, count) or not np.isfinite(matrix).all():
        raise PemError(f"correlation has shape {list(np.shape(matrix))}, need {[count, count]}")
    proper = np.array_equal(matrix, matrix.T) and (np.diag(matrix) == 1.0).all()
    if not proper or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise PemError("correlation must be symmetric, with ones, and positive definite")
    (near, far), (left, right) = model.distance_m, model.bearing_rad
    if not (0.0 < near < far < np.inf and -np.pi <= left < right <= np.pi):
        raise PemError(f"distances {near:g} to {far:g} m or bearings {left:g} to {right:g} rad: "
                       "must be above 0 and increasing, and within -pi to pi")  # fmt: skip
