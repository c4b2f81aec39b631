"""What the back ends of the braking scenario share; what proposals see of it.

How they step: :mod:`pemviz.simulators.braking.vectorized`, and highway-env's.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.config import ScenarioConfig
from pemviz.latents import NO_LATENTS, LatentCounts
from pemviz.simulators.measurement_errors import MeasurementNoise, PositionErrors
from pemviz.simulators.tracking.tracker import Tracker, TrackerState, tracker_of_text
from pemviz.types import Signal, StateBatch

GAP = "gap"
EGO_SPEED = "ego_speed"
LEAD_SPEED = "lead_speed"
SPEED_ERROR_INTEGRAL = "speed_error_integral_m"

CAR_CLASS = 0.0
NOT_TRUNCATED = 0.0
NOT_OCCLUDED = 0.0
HEADING_AWAY_RAD = -np.pi / 2
CAR_HEIGHT_M = 1.53
CAR_WIDTH_M = 1.63
EGO_LENGTH_M = 5.0
REACH = 3.0
"""Noise up to which a measured gap is expected to be too small: detections matter as far as that.
"""


class Perceived(NamedTuple):
    """What the controller is told of the lead car, and the next states remember, ``[N]``.

    It is present if it is detected, or tracked; the gap counts where it is.
    """

    present: BoolArray
    gap_m: FloatArray
    memory: Mapping[str, AnyArray]


@dataclass(frozen=True)
class BrakingScenario:
    """An ego car follows a braking lead car; a back end adds ``name`` and ``step``.

    Attributes:
        config: The scenario's parameters.
        errors: Of the measured gap, which the ego's emergency braking rule then acts on; ``None``:
            it acts on the true one.
    """

    config: ScenarioConfig
    errors: PositionErrors | None = None

    @cached_property
    def noise(self) -> MeasurementNoise | None:
        """Of the measured gap's errors; ``None`` without any."""
        return None if self.errors is None else gap_noise(self.config, self.errors)

    @property
    def latents(self) -> LatentCounts:
        """Standard normals that a rollout takes: none without errors."""
        return NO_LATENTS if self.noise is None else self.noise.latents

    @property
    def states(self) -> int:
        """States in a rollout."""
        return self.config.states

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.config.dt_s

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Gap [m], ego speed and lead speed [m/s]."""
        return scenario_signals(self.config)

    @cached_property
    def tracker(self) -> Tracker | None:
        """Between perception and controller; ``None``: the ego reacts to single detections."""
        return scenario_tracker(self.config)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """Both cars at the initial speed, arrays ``[count]``.

        Args:
            count: Number of rollouts N.
            start: With errors whose noise lasts, standard normals ``[N, 1]``.
        """
        noise, tracker = self.noise, self.tracker
        speed_mps = np.full(count, self.config.initial_speed_mps)
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={
                GAP: np.full(count, self.config.initial_gap_m),
                EGO_SPEED: speed_mps,
                LEAD_SPEED: speed_mps,
            },
            memory={
                SPEED_ERROR_INTEGRAL: np.zeros(count),
                **({} if noise is None else noise.begin(count, start)),
                **({} if tracker is None else tracker.memory(tracker.start(count))),
            },
        )

    def perceived(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None
    ) -> Perceived:
        """What the controller is told for outcomes ``[N]`` and, with errors, noise ``[N, 1]``."""
        tracker, gap_m = self.tracker, states.signals[GAP]
        noises = {} if self.noise is None else self.noise.renewed(states, noise)
        if tracker is not None:
            measured_m = gap_m + self._error_m(gap_m, noises) if noises else gap_m
            tracks = tracker.update(tracker.state(states.memory), detected, measured_m)
            memory = {**noises, **tracker.memory(tracks)}
            return Perceived(tracks.confirmed, tracks.position_m[..., 0], memory)
        if noises:  # of a car that is missed nothing is measured
            rows, gap_m = np.flatnonzero(detected), gap_m.copy()
            here = {name: values[rows] for name, values in noises.items()}
            gap_m[rows] += self._error_m(gap_m[rows], here)
        return Perceived(detected, gap_m, noises)

    def measurement_errors(
        self, signals: Mapping[str, FloatArray], memory: Mapping[str, AnyArray]
    ) -> Mapping[str, FloatArray]:
        """Error of the measured gap at each step ``[T-1]`` of a rollout ``[T]`` [m]."""
        if self.errors is None:
            return {}
        after = {name: values[1:] for name, values in memory.items()}
        return {"measured gap": self._error_m(signals[GAP][:-1], after)}

    def _error_m(self, gap_m: FloatArray, memory: Mapping[str, AnyArray]) -> FloatArray:
        """Measured minus true gaps ``[N]`` [m], by the noise of a step in the memory after it."""
        assert self.errors is not None  # noqa: S101  asked for with errors alone
        assert self.noise is not None  # noqa: S101
        return self.errors.range_error(self.salient({GAP: gap_m}), *self.noise.values(memory))

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The lead car's salient variables ``[..., 11]``."""
        return lead_car_salient(self.config, signals)


@dataclass(frozen=True)
class BrakingFeatures:
    """What a proposal sees of states: gap, closing speed and time, and the tracks.

    Attributes:
        config: The scenario's parameters.
        errors: Of the measured gap; ``None``: there are none.
    """

    config: ScenarioConfig
    errors: PositionErrors | None = None

    @cached_property
    def tracker(self) -> Tracker | None:
        """What stands between perception and controller."""
        return scenario_tracker(self.config)

    def values(self, states: StateBatch) -> FloatArray:
        """Gap [m], closing speed [m/s] and time [s] of states ``[...]``, as ``[..., 3]``.

        With errors of the measured gap the noise that the states carry is a fourth. With a tracker
        there is also what :meth:`Tracker.numbers` gives, but in place of the track's hits whether
        the outcome decides over the emergency brake at once: a polynomial of the gap cannot turn
        from one step to the next, and where a track coasts beyond the emergency gap that is where
        errors begin to matter.
        """
        gap_m = states.signals[GAP]
        columns = [gap_m, states.signals[EGO_SPEED] - states.signals[LEAD_SPEED]]
        columns.append(np.asarray(states.step * self.config.dt_s, dtype=np.float64))
        if self.errors is not None:
            columns += gap_noise(self.config, self.errors).values(states.memory)
        if self.tracker is not None:
            tracks = self.tracker.state(states.memory)
            columns += [self._decides(tracks, gap_m), *self.tracker.numbers(tracks)[1:]]
        shape = (*gap_m.shape, len(columns))
        values = np.empty(shape, dtype=np.float64)
        for place, column in enumerate(columns):
            values[..., place] = column
        return values

    def _decides(self, tracks: TrackerState, gap_m: FloatArray) -> BoolArray:
        """Whether a hit at gaps ``[...]`` brakes and a miss does not, or the other way round."""
        assert self.tracker is not None  # noqa: S101  there are tracks
        here_m, braked = gap_m[..., None], []
        for outcome in (True, False):
            after = self.tracker.update(tracks, np.full(gap_m.shape, outcome), here_m)
            braked.append(brakes(after.confirmed, after.position_m[..., 0], self.config))
        return braked[0] != braked[1]

    def reacts(self, states: StateBatch) -> BoolArray:
        """Whether a detection at states ``[...]`` would trigger the emergency brake.

        With a tracker: or may do so later, while the tracker still knows of it.
        """
        gap_m, config = states.signals[GAP], self.config
        if self.tracker is not None:
            known_s = (self.tracker.window - 1 + self.tracker.coast_steps) * config.dt_s
            closing_mps = states.signals[EGO_SPEED] - states.signals[LEAD_SPEED]
            closing_mps2 = config.lead_deceleration_mps2 + config.maximum_acceleration_mps2
            gap_m = gap_m - (closing_mps * known_s + 0.5 * closing_mps2 * known_s**2).clip(0.0)
        if self.errors is not None:
            salient = lead_car_salient(config, states.signals)
            nearest = self.errors.range_error(salient, np.full(np.shape(gap_m), -REACH))
            gap_m = gap_m + nearest.clip(max=0.0)
        return gap_m < config.emergency_gap_m


def brakes(detected: Any, gap_m: Any, config: ScenarioConfig) -> Any:
    """The emergency braking rule, for outcomes and gaps that are arrays or single values."""
    return detected & (gap_m < config.emergency_gap_m)


def gap_noise(config: ScenarioConfig, errors: PositionErrors) -> MeasurementNoise:
    """The noise of the measured gap, in states' memory as ``lasting_noise, forgetful_noise``."""
    return MeasurementNoise({"noise": errors.axes[0].memory}, config.dt_s)


def scenario_tracker(config: ScenarioConfig) -> Tracker | None:
    """The tracker that the scenario's controller has, of the gap."""
    return tracker_of_text(config.tracker, dt_s=config.dt_s, axes=1)


def scenario_signals(config: ScenarioConfig) -> tuple[Signal, ...]:
    """Gap and speeds, with the bounds that the agm metric normalises by."""
    gap_m, speed_mps = config.gap_bound_m, config.speed_bound_mps
    return (
        Signal(name=GAP, key="gap_m", unit="m", low=-gap_m, high=gap_m),
        Signal(name=EGO_SPEED, key="ego_speed_mps", unit="m/s", low=0.0, high=speed_mps),
        Signal(name=LEAD_SPEED, key="lead_speed_mps", unit="m/s", low=0.0, high=speed_mps),
    )


def lead_car_salient(config: ScenarioConfig, signals: Mapping[str, FloatArray]) -> FloatArray:
    """The lead car as KITTI would label it: an unoccluded car straight ahead, heading away.

    Args:
        config: Gives camera height and the lead car's length.
        signals: ``gap`` of any shape ``[...]`` [m].

    Returns:
        ``[..., 11]`` in the order of ``pemviz.pem.SALIENT_COLUMNS``. KITTI locates a car by
        its centre, so z is the gap and half the car's length.
    """
    gap_m = signals[GAP]
    fixed = (
        CAR_CLASS,
        NOT_TRUNCATED,
        NOT_OCCLUDED,
        HEADING_AWAY_RAD,  # alpha equals rotation_y where x = 0
        CAR_HEIGHT_M,
        CAR_WIDTH_M,
        config.lead_length_m,
        0.0,
        config.camera_height_m,
        0.0,
        HEADING_AWAY_RAD,
    )
    salient = np.empty((len(fixed), *gap_m.shape), dtype=np.float64)
    salient[...] = np.reshape(fixed, (-1, *[1] * gap_m.ndim))
    salient[9] = gap_m + config.lead_length_m / 2
    return salient.T if gap_m.ndim == 1 else np.moveaxis(salient, 0, -1)


def car_salient(
    *,
    x_m: FloatArray,
    y_m: float,
    z_m: FloatArray,
    heading_rad: FloatArray,
    size_m: tuple[float, float, float],
    truncated: FloatArray | float = NOT_TRUNCATED,
    occlusion: FloatArray | float = NOT_OCCLUDED,
) -> FloatArray:
    """Cars as KITTI would label them, ``[..., 11]``, ordered as ``pemviz.pem.SALIENT_COLUMNS``.

    Args:
        x_m: Centre to the right of the camera, ``[...]`` [m].
        y_m: Of the road below the camera [m].
        z_m: Centre ahead of the camera, ``[...]`` [m].
        heading_rad: ``[...]``, counterclockwise from the camera's direction [rad].
        size_m: Height, width and length [m].
        truncated: Share beyond the image ``[...]``.
        occlusion: KITTI's level ``[...]``.
    """
    rotation_rad = HEADING_AWAY_RAD - heading_rad
    alpha_rad = rotation_rad - np.arctan2(x_m, z_m)
    columns = (CAR_CLASS, truncated, occlusion, alpha_rad, *size_m, x_m, y_m, z_m, rotation_rad)
    salient = np.empty((*np.shape(heading_rad), len(columns)))
    for place, column in enumerate(columns):
        salient[..., place] = column
    return salient
