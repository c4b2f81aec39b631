"""Filters of a track's position and speed: constant velocity along each axis, one step at a time.

Symbols: x and v are position [m] and speed [m/s], z a measured position [m], dt the time step [s].
A filter first meets a track at a hit, predicts it at every later step, and corrects the prediction
at hits. The axes are independent of each other and filtered alike.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config.ranges import Range, check_fields
from pemviz.config.tracker_text import ALPHA, check_stable

Spread = Annotated[float, Range(low=0.0, high=1e6)]


@dataclass(frozen=True)
class Motion:
    """Where tracks are and how they move.

    Attributes:
        position_m: ``[..., A]`` along each of A axes [m].
        speed_mps: ``[..., A]`` [m/s].
        variances: ``[..., 3]``: of the position [m^2], of position with speed [m^2/s], and of the
            speed [m^2/s^2], the same along every axis; zeros under a filter that has none.
    """

    position_m: FloatArray
    speed_mps: FloatArray
    variances: FloatArray


class TrackFilter(Protocol):
    """Follows position and speed; pure and elementwise."""

    @property
    def keeps(self) -> tuple[str, ...]:
        """The fields of :class:`Motion` on which later steps depend."""
        ...

    def first(self, measured_m: FloatArray) -> Motion:
        """A track after its first hit at ``[..., A]``."""
        ...

    def predicted(self, motion: Motion, *, dt_s: float) -> Motion:
        """It one step later, without a hit."""
        ...

    def corrected(self, predicted: Motion, measured_m: FloatArray, *, dt_s: float) -> Motion:
        """The prediction after a hit at ``[..., A]``."""
        ...


@dataclass(frozen=True)
class LastPosition:
    """No filter: a track is where its last hit was, and stands."""

    @property
    def keeps(self) -> tuple[str, ...]:
        """The position."""
        return ("position_m",)

    def first(self, measured_m: FloatArray) -> Motion:
        """The measured position."""
        return at_rest(measured_m)

    def predicted(self, motion: Motion, *, dt_s: float) -> Motion:  # noqa: ARG002
        """The same."""
        return motion

    def corrected(self, predicted: Motion, measured_m: FloatArray, *, dt_s: float) -> Motion:  # noqa: ARG002
        """The measured position."""
        return at_rest(measured_m)


@dataclass(frozen=True, kw_only=True)
class AlphaBeta:
    """x + alpha r and v + beta r / dt, with r = z - x the error of the prediction.

    Attributes:
        alpha: Share of the error that corrects the position; above 0, at most 1.
        beta: Share that corrects the speed; above 0, below 4 - 2 alpha, where the filter is stable
            (Kalata 1984). ``None``: alpha^2 / (2 - alpha), which follows a manoeuvre with the least
            noise (Benedict & Bordner 1962).
    """

    alpha: Annotated[float, Range(low=0.0, low_open=True, high=1.0)] = ALPHA
    beta: Annotated[float, Range(low=0.0, low_open=True, high=4.0)] | None = None

    def __post_init__(self) -> None:
        """Refuse gains under which errors grow.

        Raises:
            ConfigError: One is out of its range.
        """
        check_fields(self, prefix="tracker: ")
        check_stable(self.alpha, self.beta)

    @property
    def keeps(self) -> tuple[str, ...]:
        """Position and speed."""
        return ("position_m", "speed_mps")

    def first(self, measured_m: FloatArray) -> Motion:
        """The measured position, at rest."""
        return at_rest(measured_m)

    def predicted(self, motion: Motion, *, dt_s: float) -> Motion:
        """Moved by v dt, with the same speed."""
        return replace(motion, position_m=motion.position_m + motion.speed_mps * dt_s)

    def corrected(self, predicted: Motion, measured_m: FloatArray, *, dt_s: float) -> Motion:
        """Both corrected by their shares of the error."""
        beta = self.alpha**2 / (2.0 - self.alpha) if self.beta is None else self.beta
        error_m = measured_m - predicted.position_m
        return replace(
            predicted,
            position_m=predicted.position_m + self.alpha * error_m,
            speed_mps=predicted.speed_mps + (beta / dt_s) * error_m,
        )


@dataclass(frozen=True, kw_only=True)
class Kalman:
    """The Kalman filter of a constant speed that random accelerations disturb.

    An acceleration is constant over a step and independent of the others ('discrete white noise
    acceleration', Bar-Shalom, Li & Kirubarajan 2001, eq. 6.3.2-4): the covariance grows by
    sd^2 [[dt^4 / 4, dt^3 / 2], [dt^3 / 2, dt^2]].

    Attributes:
        position_sd_m: Standard deviation of a measured position's error [m]; above 0.
        acceleration_sd_mps2: Of the accelerations [m/s^2]; at least 0.
        first_speed_sd_mps: Of the speed before the first hit, whose mean is 0 [m/s]; at least 0.
    """

    position_sd_m: Annotated[float, Range(low=0.0, low_open=True, high=1e6)] = 0.5
    acceleration_sd_mps2: Spread = 3.0
    first_speed_sd_mps: Spread = 10.0

    def __post_init__(self) -> None:
        """Refuse what is no standard deviation.

        Raises:
            ConfigError: One is out of its range.
        """
        check_fields(self, prefix="tracker: ")

    @property
    def keeps(self) -> tuple[str, ...]:
        """Position, speed and their covariance."""
        return ("position_m", "speed_mps", "variances")

    def first(self, measured_m: FloatArray) -> Motion:
        """The measured position with its error, at rest but for the speed's spread."""
        motion = at_rest(measured_m)
        variances = np.zeros_like(motion.variances)
        variances[..., 0] = self.position_sd_m**2
        variances[..., 2] = self.first_speed_sd_mps**2
        return replace(motion, variances=variances)

    def predicted(self, motion: Motion, *, dt_s: float) -> Motion:
        """Moved: F x and F P F' + Q, with F = [[1, dt], [0, 1]]."""
        position, both, speed = (motion.variances[..., place] for place in range(3))
        noise = self.acceleration_sd_mps2**2
        variances = np.stack(
            (
                position + 2.0 * dt_s * both + dt_s**2 * speed + noise * dt_s**4 / 4.0,
                both + dt_s * speed + noise * dt_s**3 / 2.0,
                speed + noise * dt_s**2,
            ),
            -1,
        )
        position_m = motion.position_m + motion.speed_mps * dt_s
        return replace(motion, position_m=position_m, variances=variances)

    def corrected(self, predicted: Motion, measured_m: FloatArray, *, dt_s: float) -> Motion:  # noqa: ARG002
        """Corrected: x + K r and (I - K H) P, with K = P H' / (H P H' + R) and H = [1, 0]."""
        position, both, speed = (predicted.variances[..., place] for place in range(3))
        measured = self.position_sd_m**2
        gain, speed_gain = position / (position + measured), both / (position + measured)
        error_m = measured_m - predicted.position_m
        kept = measured / (position + measured)  # 1 - gain, without cancellation
        return Motion(
            position_m=predicted.position_m + gain[..., None] * error_m,
            speed_mps=predicted.speed_mps + speed_gain[..., None] * error_m,
            variances=np.stack((position * kept, both * kept, speed - speed_gain * both), -1),
        )


def at_rest(position_m: FloatArray) -> Motion:
    """Tracks at ``[..., A]`` that stand and are known exactly."""
    shape = (*position_m.shape[:-1], 3)
    variances = np.zeros(shape, dtype=position_m.dtype)
    return Motion(position_m, np.zeros_like(position_m), variances)
