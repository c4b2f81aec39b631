"""Contact of the two cars in a rollout of the braking scenario.

The gap is measured from the ego's windscreen camera, ``CAMERA_TO_BUMPER_M`` behind its front
bumper: the specification's limit of 2 m is where the bumpers touch. Contact does not change the
simulated dynamics, so what a rollout tells after it happens in no real encounter.
"""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray

CAMERA_TO_BUMPER_M = 2.0
"""From the ego's windscreen camera ahead to its front bumper [m]."""


@dataclass(frozen=True)
class Contact:
    """Where the cars first touch.

    Attributes:
        step: Index of the first state at which they do.
        time_s: Its time [s].
        impact_speed_mps: How fast the gap closed in the step before it [m/s].
    """

    step: int
    time_s: float
    impact_speed_mps: float


def first_contact(gap_m: FloatArray, *, dt_s: float) -> Contact | None:
    """Where the cars first touch; ``None`` if they never do.

    Args:
        gap_m: Camera to the rear of the lead car, ``[T]`` [m].
        dt_s: Time step [s].
    """
    touching = np.flatnonzero(gap_m <= CAMERA_TO_BUMPER_M)
    if touching.size == 0:
        return None
    step = int(touching[0])
    closed_m = float(gap_m[step - 1] - gap_m[step]) if step else 0.0
    return Contact(step=step, time_s=step * dt_s, impact_speed_mps=closed_m / dt_s)


def contact_text(contact: Contact) -> str:
    """In words: when, and how fast."""
    return f"contact at {contact.time_s:.2f} s, impact at {contact.impact_speed_mps:.1f} m/s"
