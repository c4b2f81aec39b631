"""From what a CARLA server tells to signals, and from accelerations to its controls."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M

if TYPE_CHECKING:
    import carla


@dataclass(frozen=True)
class CarPlace:
    """A car along the road that it heads along.

    Attributes:
        rear_m: Its bounding box's rear end along the road [m].
        front_m: Its front end.
        speed_mps: Along the road.
    """

    rear_m: float
    front_m: float
    speed_mps: float


@dataclass(frozen=True)
class Pedals:
    """What an ego car is asked for, each 0 to 1."""

    throttle: float
    brake: float


def place_of(
    transform: "carla.Transform",
    velocity: "carla.Vector3D",
    box: "carla.BoundingBox",
    *,
    along: "carla.Vector3D",
) -> CarPlace:
    """Where a car is along the road.

    Args:
        transform: The actor's, in the world.
        velocity: The actor's, in the world [m/s].
        box: The actor's; its centre lies beside the actor's, and ``extent`` is half its size.
        along: The road's direction, of length 1.
    """
    ahead = transform.get_forward_vector()
    at = transform.location
    faces = ahead.x * along.x + ahead.y * along.y + ahead.z * along.z
    centre_m = at.x * along.x + at.y * along.y + at.z * along.z + faces * box.location.x
    half_m = abs(faces) * box.extent.x
    speed_mps = velocity.x * along.x + velocity.y * along.y + velocity.z * along.z
    return CarPlace(centre_m - half_m, centre_m + half_m, speed_mps)


def gap_m(ego: CarPlace, lead: CarPlace) -> float:
    """From the ego's windscreen camera to the rear of the lead car [m]."""
    return lead.rear_m - ego.front_m + CAMERA_TO_BUMPER_M


def pedals(acceleration_mps2: float, config: ScenarioConfig) -> Pedals:
    """Throttle or brake, as a share of the scenario's limits.

    Full throttle is the controller's greatest acceleration, full brake emergency braking; what the
    car makes of them is its own.

    Args:
        acceleration_mps2: Asked for by the controller.
        config: The scenario.
    """
    if acceleration_mps2 < 0.0:
        share = -acceleration_mps2 / config.emergency_deceleration_mps2
        return Pedals(throttle=0.0, brake=min(share, 1.0))
    most_mps2 = config.maximum_acceleration_mps2
    share = acceleration_mps2 / most_mps2 if most_mps2 > 0.0 else 0.0
    return Pedals(throttle=min(share, 1.0), brake=0.0)
