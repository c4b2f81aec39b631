"""What both back ends of the braking scenario share: all but how they step."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.config import ScenarioConfig
from pemviz.latents import NO_LATENTS, LatentCounts
from pemviz.simulators.braking.measured_gap import MeasuredGap, RangeErrors
from pemviz.simulators.tracking.named import tracker_of_text
from pemviz.simulators.tracking.tracker import Tracker
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


@dataclass(frozen=True)
class BrakingScenario:
    """An ego car follows a braking lead car; a back end adds ``name`` and ``step``.

    Attributes:
        config: The scenario's parameters.
        errors: Of the measured gap, which the ego's emergency braking rule then acts on; ``None``:
            it acts on the true one.
    """

    config: ScenarioConfig
    errors: RangeErrors | None = None

    @property
    def latents(self) -> LatentCounts:
        """Standard normals that a rollout takes: none without errors."""
        return NO_LATENTS if self.errors is None else self._measured.latents

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

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """Both cars at the initial speed, arrays ``[count]``.

        Args:
            count: Number of rollouts N.
            start: With errors whose noise lasts, standard normals ``[N, 1]``.
        """
        noises = {} if self.errors is None else self._measured.begin(count, start)
        speed_mps = np.full(count, self.config.initial_speed_mps)
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={
                GAP: np.full(count, self.config.initial_gap_m),
                EGO_SPEED: speed_mps,
                LEAD_SPEED: speed_mps,
            },
            memory={SPEED_ERROR_INTEGRAL: np.zeros(count), **noises, **self._no_tracks(count)},
        )

    @cached_property
    def tracker(self) -> Tracker | None:
        """Between perception and controller; ``None``: the ego reacts to single detections."""
        return scenario_tracker(self.config)

    def _no_tracks(self, count: int) -> dict[str, AnyArray]:
        tracker = self.tracker
        return {} if tracker is None else tracker.memory(tracker.start(count))

    def perceived(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None
    ) -> "Perceived":
        """What the controller is told at ``states`` ``[N]``.

        Args:
            states: ``[N]``.
            detected: Perception's outcomes ``[N]``.
            noise: As in :meth:`perceived_gap`.
        """
        tracker = self.tracker
        if tracker is None:
            gap_m, noises = self.perceived_gap(states, noise, asked=detected)
            return Perceived(detected, gap_m, noises)
        gap_m, noises = self.perceived_gap(states, noise)
        tracks = tracker.update(tracker.state(states.memory), detected, gap_m)
        memory = {**noises, **tracker.memory(tracks)}
        return Perceived(tracks.confirmed, tracks.position_m[..., 0], memory)

    def perceived_gap(
        self, states: StateBatch, noise: FloatArray | None, *, asked: BoolArray | None = None
    ) -> tuple[FloatArray, Mapping[str, FloatArray]]:
        """The gap ``[N]`` [m] that perception measures, and what states keep of its noise.

        Args:
            states: ``[N]``.
            noise: With errors, standard normals ``[N, 1]``; ``None``: 0.
            asked: Whose measured gap is needed, ``[N]``, the others get the true one; ``None``:
                that of all.
        """
        gap_m = states.signals[GAP]
        if self.errors is None:
            return gap_m, {}
        given = np.zeros((len(gap_m), 1)) if noise is None else noise
        kept = self._measured.remembered(states, given)
        if asked is None:
            salient = self.salient(states.signals)
            return gap_m + self._measured.error_m(salient, kept), kept
        rows, measured_m = np.flatnonzero(asked), gap_m.copy()
        here = {name: values[rows] for name, values in kept.items()}
        salient = self.salient({GAP: gap_m[rows]})
        measured_m[rows] += self._measured.error_m(salient, here)
        return measured_m, kept

    def told_errors(
        self, signals: Mapping[str, FloatArray], memory: Mapping[str, AnyArray]
    ) -> Mapping[str, FloatArray]:
        """Error of the measured gap at each step ``[T-1]`` of a rollout ``[T]`` [m]."""
        if self.errors is None:
            return {}
        salient = self.salient({name: values[:-1] for name, values in signals.items()})
        after = {name: values[1:] for name, values in memory.items()}
        return {"measured gap": self._measured.error_m(salient, after)}

    @property
    def _measured(self) -> MeasuredGap:
        assert self.errors is not None  # noqa: S101  asked for with errors alone
        return MeasuredGap(self.config, self.errors)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The lead car's salient variables ``[..., 11]``."""
        return lead_car_salient(self.config, signals)


@dataclass(frozen=True)
class Perceived:
    """What the controller is told of the lead car, arrays ``[N]``.

    Attributes:
        present: Whether it is there: detected, or tracked.
        gap_m: The gap to it [m], where it is there.
        memory: What the next states remember of it.
    """

    present: BoolArray
    gap_m: FloatArray
    memory: Mapping[str, AnyArray]


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
    shape = (len(fixed), *gap_m.shape)
    salient = np.empty(shape, dtype=np.float64)
    values = np.asarray(fixed, dtype=np.float64)
    salient[...] = values.reshape(-1, *[1] * gap_m.ndim)
    salient[9] = gap_m + config.lead_length_m / 2
    return salient.T if gap_m.ndim == 1 else np.moveaxis(salient, 0, -1)
