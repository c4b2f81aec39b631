"""The signals of an encounter, and those of single cars as arrays with a row for each."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters.margins import UNAVOIDABLE_S
from pemviz.types import Signal

EGO_X = "ego_x"
EGO_SPEED = "ego_speed"
EGO_ACCELERATION = "ego_acceleration"
CLEARANCE = "clearance"
SAFE_DISTANCE = "safe_distance"
NEEDLESS = "needless_deceleration"
AVOIDABLE_BY = "avoidable_by"
COLLIDED = "collided"
IMPACT_SPEED = "impact_speed"

GAP, ASIDE, SPEED, HEADING = OF_EACH = ("gap", "aside", "speed", "heading")
"""What there is of every other car, as ``gap_NAME``."""
GHOST = "ghost"
"""A slot that is about no car."""
LARGEST_MPS2 = 20.0
WIDEST_M = 50.0
TITLES = {
    "lead": "lead car",
    "cutting_in": "car that cuts in",
    "revealed": "revealed car",
    "neighbour": "neighbour",
    GHOST: "ghost",
}


class Each(NamedTuple):
    """What there is of every other car, ``[K, ...]``, in the order of :data:`OF_EACH`.

    Attributes:
        gap_m: Bumper to bumper along the road [m].
        aside_m: To the left of the ego [m].
        speed_mps: [m/s].
        heading_rad: Counterclockwise from the road [rad].
    """

    gap_m: FloatArray
    aside_m: FloatArray
    speed_mps: FloatArray
    heading_rad: FloatArray

    @staticmethod
    def of(names: Sequence[str], signals: Mapping[str, FloatArray]) -> "Each":
        """Of cars, and perhaps the ghost, with these names."""
        return Each(*(of_cars(what, names, signals) for what in OF_EACH))

    def first(self, count: int) -> "Each":
        """Of as many."""
        return Each(*(rows[:count] for rows in self))


def slot_title(name: str) -> str:
    """Name of the slot that is about a car, or about the ghost."""
    return TITLES[name]


def slot_signals(name: str) -> tuple[str, ...]:
    """Names of the signals that are about a car, or the ghost, alone."""
    return tuple(f"{what}_{name}" for what in OF_EACH)


def encounter_signals(config: EncounterConfig, names: Sequence[str]) -> tuple[Signal, ...]:
    """All signals of slots with these names, with the bounds that the agm metric normalises by."""
    gap_m, speed_mps = config.gap_bound_m, config.speed_bound_mps
    found = [
        Signal(EGO_X, "ego_x_m", "m", low=-gap_m, high=gap_m),
        Signal(EGO_SPEED, "ego_speed_mps", "m/s", low=0.0, high=speed_mps),
        Signal(
            EGO_ACCELERATION,
            "ego_acceleration_mps2",
            "m/s^2",
            low=-LARGEST_MPS2,
            high=LARGEST_MPS2,
        ),
    ]
    for name in names:
        found += [
            Signal(f"{GAP}_{name}", f"{GAP}_{name}_m", "m", low=-gap_m, high=gap_m),
            Signal(f"{ASIDE}_{name}", f"{ASIDE}_{name}_m", "m", low=-WIDEST_M, high=WIDEST_M),
            Signal(f"{SPEED}_{name}", f"{SPEED}_{name}_mps", "m/s", low=0.0, high=speed_mps),
            Signal(f"{HEADING}_{name}", f"{HEADING}_{name}_rad", "rad", low=-1.0, high=1.0),
        ]
    found += [
        Signal(CLEARANCE, "clearance_m", "m", low=-gap_m, high=gap_m),
        Signal(SAFE_DISTANCE, "safe_distance_m", "m", low=-gap_m, high=gap_m),
        Signal(NEEDLESS, f"{NEEDLESS}_mps2", "m/s^2", low=0.0, high=LARGEST_MPS2),
    ]
    if config.logical_scenario == "cut-in":
        found.append(
            Signal(AVOIDABLE_BY, "avoidable_by_s", "s", low=UNAVOIDABLE_S, high=-UNAVOIDABLE_S)
        )
    found += [
        Signal(COLLIDED, COLLIDED, "", low=0.0, high=1.0),
        Signal(IMPACT_SPEED, "impact_speed_mps", "m/s", low=0.0, high=speed_mps),
    ]
    return tuple(found)


def of_cars(what: str, cars: Sequence[str], signals: Mapping[str, AnyArray]) -> AnyArray:
    """One signal, or a part of a memory, of all cars, ``[K, ...]``."""
    return np.stack([signals[f"{what}_{car}"] for car in cars])


def by_car(what: str, cars: Sequence[str], values: AnyArray) -> dict[str, AnyArray]:
    """Arrays ``[K, ...]`` as one for each car by name."""
    return {f"{what}_{car}": one for car, one in zip(cars, values, strict=True)}
