"""Contact of the two cars in the braking scenario, and the scene that views draw of it.

The gap is measured from the ego's windscreen camera, ``CAMERA_TO_BUMPER_M`` behind its front
bumper: the specification's limit of 2 m is where the bumpers touch. Contact does not change the
simulated dynamics, so what a rollout tells after it happens in no real encounter.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.simulators.braking.scenario import (
    CAR_HEIGHT_M,
    CAR_WIDTH_M,
    EGO_LENGTH_M,
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
)
from pemviz.simulators.scene import Road, SceneCar, SceneStates, SceneZone

CAMERA_TO_BUMPER_M = 2.0
"""From the ego's windscreen camera ahead to its front bumper [m]."""
LANE_M = 3.5
DRAWN_SIGNALS = frozenset({GAP, EGO_SPEED, LEAD_SPEED})


@dataclass(frozen=True)
class Contact:
    """The first state at which the cars touch, and how fast the gap closed in the step to it."""

    step: int
    time_s: float
    impact_speed_mps: float

    def __str__(self) -> str:
        return f"contact at {self.time_s:.2f} s, impact at {self.impact_speed_mps:.1f} m/s"


def first_contact(gap_m: FloatArray, *, dt_s: float) -> Contact | None:
    """Where the cars first touch, of gaps ``[T]`` [m]; ``None`` if they never do."""
    touching = np.flatnonzero(gap_m <= CAMERA_TO_BUMPER_M)
    if touching.size == 0:
        return None
    step = int(touching[0])
    closed_m = float(gap_m[step - 1] - gap_m[step]) if step else 0.0
    return Contact(step=step, time_s=step * dt_s, impact_speed_mps=closed_m / dt_s)


@dataclass(frozen=True)
class FollowedCar:
    """Any scenario of a gap, measured from the ego's windscreen camera, and two speeds.

    Attributes:
        dt_s: Time step [s].
        lead_length_m: Of the car ahead.
        emergency_gap_m: Below which a detection brakes hard; 0: nothing is said of it.
    """

    dt_s: float
    lead_length_m: float = EGO_LENGTH_M
    emergency_gap_m: float = 0.0

    @property
    def scene_cars(self) -> tuple[SceneCar, ...]:
        """The ego, and the car ahead that perception is asked about."""
        ahead_m = self.emergency_gap_m - CAMERA_TO_BUMPER_M
        words = f"a detection nearer than {self.emergency_gap_m:g} m brakes hard"
        zone = SceneZone(ahead_m, words) if ahead_m > 0.0 else None
        return (
            SceneCar("ego", EGO_LENGTH_M, CAR_WIDTH_M, CAR_HEIGHT_M, zone=zone),
            SceneCar("lead", self.lead_length_m, CAR_WIDTH_M, CAR_HEIGHT_M),
        )

    @property
    def road(self) -> Road:
        """One lane, and one for what comes the other way."""
        return Road((-LANE_M / 2, LANE_M / 2, 1.5 * LANE_M))

    def scene(self, signals: Mapping[str, FloatArray]) -> SceneStates:
        """Where both cars are, of whole rollouts ``[..., T]``: nothing moves on after contact.

        Positions are sums of speeds by explicit Euler, as the simulators step.
        """
        gap_m, ego_mps = np.asarray(signals[GAP]), np.asarray(signals[EGO_SPEED])
        touching = np.logical_or.accumulate(gap_m <= CAMERA_TO_BUMPER_M, axis=-1)
        moved_m = np.where(touching, 0.0, ego_mps)[..., :-1] * self.dt_s
        ego_m, closed_mps = np.zeros_like(gap_m), np.zeros_like(gap_m)
        ego_m[..., 1:] = np.cumsum(moved_m, axis=-1)
        closed_mps[..., 1:] = (gap_m[..., :-1] - gap_m[..., 1:]) / self.dt_s
        drawn_m = np.where(touching, CAMERA_TO_BUMPER_M, gap_m) - CAMERA_TO_BUMPER_M
        lead_m = ego_m + (EGO_LENGTH_M + self.lead_length_m) / 2 + drawn_m
        x_m = np.stack([ego_m, lead_m], axis=-1)
        return SceneStates(
            x_m=x_m,
            y_m=np.zeros_like(x_m),
            heading_rad=np.zeros_like(x_m),
            speed_mps=np.stack([ego_mps, np.asarray(signals[LEAD_SPEED])], axis=-1),
            present=np.ones(x_m.shape, dtype=np.bool_),
            collided=touching,
            impact_speed_mps=closed_mps,
        )
