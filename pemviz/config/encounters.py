"""A logical scenario: what is fixed about its encounters, and what is sampled for each.

``pemviz.simulators.encounters`` says exactly what the numbers do.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from pemviz.config.ranges import Range

NO_LOGICAL_SCENARIO = "none"
LOGICAL_SCENARIOS = ("braking", "cut-in", "cut-out")
LogicalScenarioName = Literal["none", "braking", "cut-in", "cut-out"]
Positive = Range(low=0.0, low_open=True, high=1e6)
Size = Annotated[float, Range(low=0.0, low_open=True, high=30.0)]
Acceleration = Annotated[float, Range(low=0.0, high=20.0)]
Gain = Annotated[float, Range(low=0.0, high=100.0)]
Seconds = Annotated[float, Range(low=0.0, high=100.0)]


@dataclass(frozen=True)
class StartChoice:
    """A start value of an encounter with a distribution of the user's own.

    Attributes:
        name: Of the start value, e.g. ``gap``.
        distribution: A number, which fixes it, or a distribution as
            ``pemviz.config.distribution_text`` reads it.
    """

    name: str
    distribution: str


@dataclass(frozen=True, kw_only=True)
class EncounterConfig:
    """A logical scenario with random starts; ``pemviz.simulators.encounters`` says exactly."""

    logical_scenario: LogicalScenarioName = NO_LOGICAL_SCENARIO
    """Logical scenario: braking (a lead car brakes), cut-in (a car cuts in), cut-out (a lead
    car leaves the lane and reveals a slower one), or none: the braking scenario with one start."""
    side: Literal["left", "right"] = "right"
    """Lane from which a car cuts in, or into which one cuts out."""
    neighbour: bool = False
    """Also a car that keeps to the lane on the other side."""
    ghost_probability: Annotated[float, Range(low=0.0, high=0.5)] = 0.0
    """How likely perception reports, at a step, a standing car at a place in the ego's lane where
    none is, which lies ghost_gap ahead at the start; 0 to 0.5. 0: there is no such place."""
    dt_s: Annotated[float, Range(low=0.001, high=1.0)] = 0.1
    """Time step [s]; 0.001 to 1."""
    states: Annotated[int, Range(low=2, high=100_000)] = 91
    """States in a rollout (T); perception acts at all but the last; 2 to 100000."""
    lane_width_m: Annotated[float, Range(low=0.0, low_open=True, high=30.0)] = 3.5
    """Width of a lane [m]; above 0 to 30."""
    car_length_m: Size = 4.5
    """Length of every car [m]; above 0 to 30."""
    car_width_m: Size = 1.8
    """Width of every car [m]; above 0 to 30."""
    car_height_m: Size = 1.5
    """Height of every car [m]; above 0 to 30."""
    camera_height_m: Annotated[float, Range(low=0.0, low_open=True, high=100.0)] = 1.65
    """Camera above the road [m]; above 0 to 100."""
    camera_to_bumper_m: Annotated[float, Range(low=0.0, high=30.0)] = 2.0
    """From the camera ahead to the ego's front bumper [m]; 0 to 30."""
    camera_half_angle_deg: Annotated[float, Range(low=1.0, high=89.0)] = 40.7
    """Half of the camera's horizontal field of view [degrees]; 1 to 89."""
    farthest_m: Annotated[float, Positive] = 80.0
    """A car whose centre is farther ahead than this is out of view [m]; above 0 to 1e6."""
    path_half_width_m: Annotated[float, Range(low=0.0, high=30.0)] = 1.45
    """A car is in the ego's path if its near side is less than this beside the ego's centre line
    [m]; 0 to 30."""
    time_gap_s: Seconds = 1.5
    """The gap that the ego keeps, as a time at its own speed [s]; 0 to 100."""
    standstill_gap_m: Annotated[float, Range(low=0.0, high=100.0)] = 2.0
    """What it keeps beyond that [m]; 0 to 100."""
    gap_gain_per_s2: Gain = 0.2
    """Acceleration per metre of gap too much [1/s^2]; 0 to 100."""
    closing_gain_per_s: Gain = 0.8
    """Deceleration per m/s by which the ego is the faster one [1/s]; 0 to 100."""
    speed_gain_per_s: Gain = 0.5
    """Acceleration per m/s below the ego's set speed [1/s]; 0 to 100."""
    maximum_acceleration_mps2: Acceleration = 2.0
    """Most that the ego accelerates [m/s^2]; 0 to 20."""
    maximum_deceleration_mps2: Acceleration = 5.0
    """Most that it decelerates to keep speed and gap [m/s^2]; 0 to 20."""
    hard_deceleration_mps2: Annotated[float, Range(low=0.0, low_open=True, high=20.0)] = 8.0
    """How hard it brakes when the time to collision is too small [m/s^2]; above 0 to 20."""
    hard_reserve_s: Seconds = 0.5
    """A time to collision is too small if it leaves less than this to spare before hard braking
    has to begin [s]; 0 to 100."""
    reaction_time_s: Seconds = 0.5
    """Of the safe distance that the rules ask for [s]; 0 to 100."""
    recovery_time_s: Seconds = 3.0
    """For so long after a car came in front the safe distance to it may be too small [s]; 0 to 100.
    """
    gap_bound_m: Annotated[float, Positive] = 500.0
    """The agm metric normalises gaps from minus to plus this value [m]; above 0 to 1e6."""
    speed_bound_mps: Annotated[float, Positive] = 60.0
    """The agm metric normalises speeds from 0 to this value [m/s]; above 0 to 1e6."""


@dataclass(frozen=True, kw_only=True)
class StartValue:
    """A value that an encounter samples at its start.

    Attributes:
        name: In options, files and tables.
        unit: Of the value.
        low: For axes of pictures, in ``unit``.
        high: Likewise.
        distribution: By default, as ``pemviz.config.distribution_text`` reads it.
    """

    name: str
    unit: str
    low: float
    high: float
    distribution: str

    @property
    def key(self) -> str:
        """The name with its unit, as files have it."""
        return f"{self.name}_{KEYS[self.unit]}"


KEYS = {"m": "m", "m/s": "mps", "s": "s", "m/s^2": "mps2"}


def _start(name: str, unit: str, axis: tuple[float, float], distribution: str) -> StartValue:
    return StartValue(name=name, unit=unit, low=axis[0], high=axis[1], distribution=distribution)


_FAST = _start("ego_speed", "m/s", (10.0, 40.0), "normal(28, 4) in [18, 36]")
_DURATION = _start("duration", "s", (0.0, 12.0), "lognormal(4.2, 0.45) in [2.5, 10]")

START_VALUES: Mapping[str, tuple[StartValue, ...]] = {
    "braking": (
        _FAST,
        _start("gap", "m", (0.0, 150.0), "lognormal(45, 0.35) in [25, 150]"),
        _start("closing_speed", "m/s", (-10.0, 15.0), "normal(0, 1) in [-3, 3]"),
        _start("brake_time", "s", (0.0, 5.0), "uniform(0.5, 2.5)"),
        _start("deceleration", "m/s^2", (0.0, 10.0), "lognormal(2.2, 0.4) in [0.5, 4]"),
    ),
    "cut-in": (
        _FAST,
        _start("gap", "m", (0.0, 120.0), "lognormal(25, 0.4) in [15, 100]"),
        _start("closing_speed", "m/s", (-10.0, 15.0), "normal(3, 3) in [0, 9]"),
        _start("cut_in_time", "s", (0.0, 5.0), "uniform(0.5, 2)"),
        _DURATION,
        _start("lead_gap", "m", (0.0, 150.0), "lognormal(40, 0.3) in [15, 150]"),
    ),
    "cut-out": (
        _start("ego_speed", "m/s", (10.0, 40.0), "normal(20, 2.5) in [14, 26]"),
        _start("gap", "m", (0.0, 120.0), "lognormal(35, 0.25) in [20, 80]"),
        _start("closing_speed", "m/s", (-10.0, 15.0), "normal(0, 1) in [-2, 2]"),
        _start("cut_out_time", "s", (0.0, 5.0), "uniform(0.5, 2)"),
        _DURATION,
        _start("margin", "s", (0.0, 6.0), "lognormal(1.5, 0.25) in [1, 4]"),
        _start("revealed_speed", "m/s", (0.0, 20.0), "uniform(0, 10)"),
    ),
}
"""By logical scenario; where they come from stands in ``pemviz.simulators.encounters``."""
NEIGHBOUR_GAP = _start("neighbour_gap", "m", (-50.0, 100.0), "uniform(5, 60)")
FALSE_POSITIVE_GAP = _start("ghost_gap", "m", (0.0, 250.0), "uniform(20, 200)")


def start_values(config: EncounterConfig) -> tuple[StartValue, ...]:
    """What an encounter samples at its start, in the order of its latents; nothing without one."""
    own = START_VALUES.get(config.logical_scenario, ())
    if not own:
        return ()
    neighbour = (NEIGHBOUR_GAP,) if config.neighbour else ()
    return (*own, *neighbour, *((FALSE_POSITIVE_GAP,) if config.ghost_probability else ()))
