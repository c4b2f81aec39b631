"""Both cars of the braking scenario on a straight road, as other tools want them.

x points ahead and is 0 at the ego's rear bumper when the rollout begins; y points to the left and
is 0 in the middle of the lane. A rollout keeps the gap, from the ego's windscreen camera to the
lead car's rear bumper, and speeds. Positions follow as the simulators step (explicit Euler): the
ego's by its speeds, the lead car's by the gap. So the bumpers touch, in whatever reference point a
format counts, at the state at which :func:`pemviz.simulators.braking.contact.first_contact` says
so. Trajectories hold the whole rollout; what it tells after contact happens in no encounter.
"""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.errors import InputError
from pemviz.runs.kept_rollout import KeptRollout
from pemviz.sampling.state.visibility import SEEN_LOGIT, VISIBILITY
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M, Contact, first_contact
from pemviz.simulators.braking.scenario import EGO_LENGTH_M, scenario_signals
from pemviz.types import LAST_OUTCOME

REMEMBERED = {signal.key for signal in (LAST_OUTCOME, VISIBILITY, SEEN_LOGIT)}
"""What runs keep of perception's memory beside the scenario's own signals."""
FARTHEST = 1e9
"""Beyond any position [m] or speed [m/s]."""
LANE_WIDTH_M = 3.5
ROAD_BEFORE_M, ROAD_BEYOND_M = 50.0, 100.0


@dataclass(frozen=True)
class CarMotion:
    """The ego or the lead car along a rollout: its rear bumper ``[T]`` [m], its speed ``[T]``."""

    name: str
    length_m: float
    rear_m: FloatArray
    speed_mps: FloatArray

    @property
    def centre_m(self) -> FloatArray:
        """Where its middle is ``[T]`` [m]."""
        return self.rear_m + self.length_m / 2


@dataclass(frozen=True)
class BrakingMotion:
    """Both cars, and what perception and contact make of them.

    Attributes:
        ego: The car that perceives.
        lead: The car before it.
        dt_s: Time between two states [s].
        missed: Steps at which perception missed the lead car, ascending.
        contact: Where the bumpers first touch; ``None`` if they never do.
    """

    ego: CarMotion
    lead: CarMotion
    dt_s: float
    missed: IntArray
    contact: Contact | None

    @property
    def states(self) -> int:
        """States T."""
        return self.ego.rear_m.size

    @property
    def time_s(self) -> FloatArray:
        """``[T]`` times of the states [s]."""
        return np.arange(self.states, dtype=np.float64) * self.dt_s

    @property
    def end_m(self) -> float:
        """How far along the road a car comes [m]."""
        return float(max(np.max(car.rear_m) + car.length_m for car in (self.ego, self.lead)))


def braking_motion(rollout: KeptRollout, *, form: str) -> BrakingMotion:
    """The cars of a rollout of the shipped scenario, for a format that messages name.

    Raises:
        InputError: It is of another simulator, or its signals are not that scenario's.
    """
    scenario = rollout.scenario
    if scenario is None:
        message = (
            f"format = {form}: knows the shipped braking scenario alone, this run is of simulator "
            f"{rollout.result.config.simulator!r}; take csv or parquet"
        )
        raise InputError(message)
    keys = [signal.key for signal in scenario_signals(scenario)]
    others = set(rollout.signals) - set(keys) - REMEMBERED
    if others or not set(keys) <= set(rollout.signals) or set(rollout.detected) != {""}:
        message = f"format = {form}: the rollouts must hold {', '.join(keys)} alone"
        raise InputError(message)
    gap_m, ego_mps, lead_mps = (rollout.signals[key] for key in keys)
    if not all(np.all(np.abs(values) <= FARTHEST) for values in (gap_m, ego_mps, lead_mps)):
        message = f"format = {form}: the rollout holds what is no gap or speed"
        raise InputError(message)
    ego_rear_m = np.concatenate([[0.0], np.cumsum(ego_mps[:-1] * scenario.dt_s)])
    camera_m = ego_rear_m + (EGO_LENGTH_M - CAMERA_TO_BUMPER_M)
    return BrakingMotion(
        ego=CarMotion("ego", EGO_LENGTH_M, ego_rear_m, ego_mps),
        lead=CarMotion("lead", scenario.lead_length_m, camera_m + gap_m, lead_mps),
        dt_s=scenario.dt_s,
        missed=np.flatnonzero(~rollout.detected[""]),
        contact=first_contact(gap_m, dt_s=scenario.dt_s),
    )


def description(rollout: KeptRollout, motion: BrakingMotion) -> str:
    """The rollout in one line: which it is, its verdict, contact, misses."""
    verdict = "violates" if rollout.violated else "holds"
    contact = "no contact" if motion.contact is None else str(motion.contact)
    return (
        f"pemviz run {rollout.result.run_id}, rank {rollout.rank} (repetition "
        f"{rollout.repetition}, stage {rollout.stage}, rollout {rollout.rollout}): {verdict} "
        f"{rollout.result.config.spec}, robustness {rollout.robustness:.6g}; {contact}; "
        f"perception misses at {motion.missed.size} of {motion.states - 1} steps"
    )


def facts(rollout: KeptRollout, motion: BrakingMotion) -> dict[str, str]:
    """What a format has no words for, by name; steps and times separated by blanks."""
    contact = motion.contact
    at_s = motion.time_s[motion.missed]
    return {
        "run_id": rollout.result.run_id,
        "rank": str(rollout.rank),
        "robustness": repr(rollout.robustness),
        "violated": "true" if rollout.violated else "false",
        "contact_time_s": "" if contact is None else f"{contact.time_s:.9g}",
        "impact_speed_mps": "" if contact is None else f"{contact.impact_speed_mps:.9g}",
        "camera_to_front_bumper_m": f"{CAMERA_TO_BUMPER_M:g}",
        "missed_steps": " ".join(str(step) for step in motion.missed),
        "missed_times_s": " ".join(f"{time:.9g}" for time in at_s),
    }
