"""The signals of an encounter, and those of single cars as arrays with a row for each."""

from collections.abc import Mapping, Sequence

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.config import EncounterConfig
from pemviz.simulators.families.margins import UNAVOIDABLE_S
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
LARGEST_MPS2 = 20.0
WIDEST_M = 50.0
TITLES = {
    "lead": "lead car",
    "cutting_in": "car that cuts in",
    "revealed": "revealed car",
    "neighbour": "neighbour",
}


def slot_title(car: str) -> str:
    """Name of the slot that is about a car."""
    return TITLES[car]


def slot_signals(car: str) -> tuple[str, ...]:
    """Names of the signals that are about a car alone."""
    return tuple(f"{what}_{car}" for what in OF_EACH)


def encounter_signals(config: EncounterConfig, cars: Sequence[str]) -> tuple[Signal, ...]:
    """All signals, with the bounds that the agm metric normalises by."""
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
    for car in cars:
        found += [
            Signal(f"{GAP}_{car}", f"{GAP}_{car}_m", "m", low=-gap_m, high=gap_m),
            Signal(f"{ASIDE}_{car}", f"{ASIDE}_{car}_m", "m", low=-WIDEST_M, high=WIDEST_M),
            Signal(f"{SPEED}_{car}", f"{SPEED}_{car}_mps", "m/s", low=0.0, high=speed_mps),
            Signal(f"{HEADING}_{car}", f"{HEADING}_{car}_rad", "rad", low=-1.0, high=1.0),
        ]
    found += [
        Signal(CLEARANCE, "clearance_m", "m", low=-gap_m, high=gap_m),
        Signal(SAFE_DISTANCE, "safe_distance_m", "m", low=-gap_m, high=gap_m),
        Signal(NEEDLESS, f"{NEEDLESS}_mps2", "m/s^2", low=0.0, high=LARGEST_MPS2),
    ]
    if config.family == "cut-in":
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
