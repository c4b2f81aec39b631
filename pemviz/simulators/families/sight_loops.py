"""What the camera sees, rollout by rollout, as numba compiles it: ``sight.py``, to the last bit."""

from typing import NamedTuple

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.families.loops import EncounterNumbers

COLUMNS = 11
"""Of salient variables."""
NEAR, LEFT, RIGHT, LOW, HIGH = range(5)
"""Of each car: its near end, and from where to where it reaches in the image, before the image's
edges cut it off and after."""


class Seen(NamedTuple):
    """Of cars ``[K, N]``: truncated and occluded shares, and which are to be seen."""

    truncated: FloatArray
    occluded: FloatArray
    present: BoolArray


class Placed(NamedTuple):
    """Of cars ``[K, N]``: where they are in the camera's frame, as ``sight.py`` has it."""

    x_m: FloatArray
    z_m: FloatArray
    bearing_rad: FloatArray
    heading_rad: FloatArray


def see(numbers: EncounterNumbers, gap_m: FloatArray, aside_m: FloatArray, seen: Seen) -> None:
    """Write what is seen of cars at ``[K, N]``."""
    cars, count = gap_m.shape
    ends = np.empty((cars, 5))
    for n in range(count):
        for car in range(cars):
            near_m = gap_m[car, n] + numbers.camera_to_bumper_m
            place(numbers, ends, car, near_m, aside_m[car, n])
        for car in range(cars):
            width = max(ends[car, HIGH] - ends[car, LOW], 0.0)
            seen.truncated[car, n] = 1.0 - width / (ends[car, RIGHT] - ends[car, LEFT])
            share = covered(numbers, ends, car) / width if width > 0.0 else 0.0
            seen.occluded[car, n] = share
            z_m = ends[car, NEAR] + numbers.length_m / 2
            in_view = z_m > numbers.nearest_m and z_m <= numbers.farthest_m
            seen.present[car, n] = in_view and width > 0.0 and share < numbers.hidden


def place(
    numbers: EncounterNumbers, ends: FloatArray, car: int, near_m: float, aside_m: float
) -> None:
    """Write where a car is in the image."""
    near = max(near_m, numbers.nearest_m)
    far = max(near_m + numbers.length_m, numbers.nearest_m)
    left_m, right_m = -aside_m - numbers.width_m / 2, -aside_m + numbers.width_m / 2
    left, right = min(left_m / near, left_m / far), max(right_m / near, right_m / far)
    ends[car, NEAR], ends[car, LEFT], ends[car, RIGHT] = near_m, left, right
    ends[car, LOW], ends[car, HIGH] = max(left, -numbers.edge), min(right, numbers.edge)


def covered(numbers: EncounterNumbers, ends: FloatArray, car: int) -> float:
    """How much of a car's width in the image others cover: at most two of them."""
    total, last_low, last_high, last = 0.0, 0.0, 0.0, 0.0
    for other in range(ends.shape[0]):
        near_m = ends[other, NEAR]
        nearer = near_m < ends[car, NEAR] or (other < car and near_m == ends[car, NEAR])
        if other == car or not nearer or near_m + numbers.length_m / 2 <= numbers.nearest_m:
            continue
        low = max(ends[car, LOW], ends[other, LEFT])
        high = min(ends[car, HIGH], ends[other, RIGHT])
        length = max(high - low, 0.0)
        total += length
        if last > 0.0 and length > 0.0:
            total -= max(min(last_high, high) - max(last_low, low), 0.0)
        last_low, last_high, last = low, high, length
    return total


def describe(numbers: EncounterNumbers, placed: Placed, seen: Seen, salient: FloatArray) -> None:
    """Write the salient variables of cars ``[K, N, 11]``."""
    cars, count = placed.x_m.shape
    for car in range(cars):
        for n in range(count):
            own, rotation = salient[car, n], numbers.away_rad - placed.heading_rad[car, n]
            share = seen.occluded[car, n]
            own[0], own[1] = numbers.car_class, seen.truncated[car, n]
            own[2] = (1.0 if share >= numbers.partly else 0.0) + (
                1.0 if share >= numbers.largely else 0.0
            )
            own[3] = rotation - placed.bearing_rad[car, n]
            own[4], own[5], own[6] = numbers.height_m, numbers.width_m, numbers.length_m
            own[7], own[8], own[9] = placed.x_m[car, n], numbers.camera_height_m, placed.z_m[car, n]
            own[10] = rotation
