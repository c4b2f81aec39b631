"""What SUMO's process and the simulator around it both know; needs neither libsumo nor numpy."""

from dataclasses import dataclass

SLOTS = ("first", "second", "third")
OTHERS = ("other1", "other2", "other3", "other4")
"""Cars that perception is not asked about: for pictures."""
OF_SLOT = ("gap", "aside", "speed", "heading")
OF_OTHER = ("gap", "aside", "speed")
OF_EGO = (
    "distance",
    "ego_speed",
    "ego_acceleration",
    "wanted_speed",
    "clearance",
    "safe_distance",
    "needless_deceleration",
    "collided",
)
SIGHT_M = 100.0
VIEW_SLOPE = 1.7320508075688772
"""Tangent of 60 degrees."""
NOBODY_M = 500.0
"""Gap, clearance and margin where there is nobody."""
PATH_HALF_WIDTH_M = 1.45
"""As :class:`pemviz.config.EncounterConfig` has it."""
REACTION_S, BRAKING_MPS2, RECOVERY_S = 0.5, 8.0, 3.0
"""Of the safe distance, likewise."""
STAYS_BY_M = 5.0
"""So much nearer counts who has a slot already."""


@dataclass(frozen=True)
class TrafficSettings:
    """What SUMO's process is told once.

    Attributes:
        config: Path of the ``.sumocfg``.
        ego: The ego's id in it.
        warm_up_s: For how long SUMO drives the ego, which has entered, before the rollout [s].
        step_s: Of a step [s], whole milliseconds.
    """

    config: str
    ego: str
    warm_up_s: float
    step_s: float


def signal_names() -> tuple[str, ...]:
    """In the order in which SUMO's process tells them."""
    of_slots = (f"{what}_{slot}" for slot in SLOTS for what in OF_SLOT)
    of_others = (f"{what}_{other}" for other in OTHERS for what in OF_OTHER)
    return (*OF_EGO, *of_slots, *of_others)
