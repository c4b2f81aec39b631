"""How one encounter begins and what its other cars do, for the highway-env back end.

Written from the specification in ``pemviz/simulators/encounters/__init__.py`` alone, one encounter
at a time.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from pemviz.arrays import FloatArray
from pemviz.config import EncounterConfig, StartChoice
from pemviz.config.distribution_text import Distribution, read_distribution
from pemviz.config.encounters import start_values

EXACT = 1e-15


class Place(NamedTuple):
    """Where a car is.

    Attributes:
        x_m: Its centre along the road.
        y_m: To the left.
        speed_mps: Where it heads.
        heading_rad: Counterclockwise from the road's direction.
    """

    x_m: float
    y_m: float
    speed_mps: float
    heading_rad: float

    @property
    def along_mps(self) -> float:
        """Speed along the road [m/s]."""
        return self.speed_mps * math.cos(self.heading_rad)


@dataclass(frozen=True)
class Course:
    """What one of the other cars does.

    Attributes:
        name: Of the car.
        start: Where it begins; its heading is not looked at.
        to_m: Where it goes to the side [m].
        begin_s: When it begins to.
        within_s: How long that takes; 0: it keeps to its lane.
        deceleration_mps2: Of its braking.
        brake_time_s: When that begins.
    """

    name: str
    start: Place
    to_m: float = 0.0
    begin_s: float = 0.0
    within_s: float = 0.0
    deceleration_mps2: float = 0.0
    brake_time_s: float = 0.0

    def profile(self, config: EncounterConfig, time_s: float) -> float:  # noqa: ARG002
        """Where it is to be to the side at a time [m]."""
        if self.within_s == 0.0:
            return self.start.y_m
        share = minimum_jerk((time_s - self.begin_s) / self.within_s)
        return self.start.y_m + (self.to_m - self.start.y_m) * share

    def acceleration(self, time_s: float) -> float:
        """Over the step that begins at a time [m/s^2]."""
        return -self.deceleration_mps2 if time_s >= self.brake_time_s else 0.0


def minimum_jerk(u: float) -> float:
    """S(u) = 10 u^3 - 15 u^4 + 6 u^5 between 0 and 1 (Flash & Hogan 1985)."""
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10.0 + u * (6.0 * u - 15.0))


@lru_cache
def time_share(covered: float) -> float:
    """The u with S(u) = ``covered``, from 0 to 1."""
    if covered <= 0.0 or covered >= 1.0:
        return float(covered >= 1.0)

    def lacking(u: float) -> float:
        return minimum_jerk(u) - covered

    root: Any = brentq(lacking, 0.0, 1.0, xtol=EXACT)
    return root


def encounter_distributions(
    config: EncounterConfig, chosen: Sequence[StartChoice]
) -> Mapping[str, Distribution]:
    """Of the start values by name, in their order.

    Raises:
        ConfigError: One cannot be read.
    """
    texts = {value.name: value.distribution for value in start_values(config)}
    texts |= {choice.name: choice.distribution for choice in chosen}
    return {name: read_distribution(text, name=f"start.{name}") for name, text in texts.items()}


def drawn(distributions: Mapping[str, Distribution], normals: FloatArray) -> dict[str, float]:
    """Start values for standard normals ``[S]``; a fixed one takes none."""
    rest = iter(normals)
    return {
        name: float(one.of(np.array([0.0 if one.fixed else next(rest)]))[0])
        for name, one in distributions.items()
    }


def courses(config: EncounterConfig, values: Mapping[str, float]) -> list[Course]:
    """The other cars of an encounter with these start values, in their order."""
    found = {"braking": _braking, "cut-in": _cut_in, "cut-out": _cut_out}[config.logical_scenario](
        config, values
    )
    if config.neighbour:
        side = -_side(config) * config.lane_width_m
        found.append(
            Course("neighbour", _place(config, values["neighbour_gap"], side, values["ego_speed"]))
        )
    return found


def _side(config: EncounterConfig) -> float:
    return 1.0 if config.side == "left" else -1.0


def _place(config: EncounterConfig, gap_m: float, y_m: float, speed_mps: float) -> Place:
    return Place(gap_m + config.car_length_m, y_m, max(speed_mps, 0.0), 0.0)


def _braking(config: EncounterConfig, values: Mapping[str, float]) -> list[Course]:
    speed_mps = values["ego_speed"] - values["closing_speed"]
    return [
        Course(
            "lead",
            _place(config, values["gap"], 0.0, speed_mps),
            deceleration_mps2=values["deceleration"],
            brake_time_s=values["brake_time"],
        )
    ]


def _cut_in(config: EncounterConfig, values: Mapping[str, float]) -> list[Course]:
    width_m, speed_mps = config.lane_width_m, values["ego_speed"]
    u = time_share(max(width_m - config.car_width_m, 0.0) / (2.0 * width_m))
    until_s = values["cut_in_time"] + u * values["duration"]
    gap_m = values["gap"] + min(values["closing_speed"], max(speed_mps, 0.0)) * until_s
    return [
        Course(
            "cutting_in",
            _place(config, gap_m, _side(config) * width_m, speed_mps - values["closing_speed"]),
            begin_s=values["cut_in_time"],
            within_s=values["duration"],
        ),
        Course(
            "lead",
            _place(config, gap_m + config.car_length_m + values["lead_gap"], 0.0, speed_mps),
        ),
    ]


def _cut_out(config: EncounterConfig, values: Mapping[str, float]) -> list[Course]:
    lead = _place(config, values["gap"], 0.0, values["ego_speed"] - values["closing_speed"])
    u = time_share(min(config.car_width_m / config.lane_width_m, 1.0))
    until_s = values["cut_out_time"] + u * values["duration"] + values["margin"]
    closing_mps = max(lead.speed_mps - values["revealed_speed"], 0.0)
    gap_m = values["gap"] + config.car_length_m + closing_mps * until_s
    return [
        Course(
            "lead",
            lead,
            to_m=_side(config) * config.lane_width_m,
            begin_s=values["cut_out_time"],
            within_s=values["duration"],
        ),
        Course("revealed", _place(config, gap_m, 0.0, values["revealed_speed"])),
    ]
