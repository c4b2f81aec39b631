"""What perception of an encounter depends on, and what it measures.

The ego's camera sees the other cars: truncation, occlusion, presence. A ghost is a place in the
ego's lane that perception may take for a standing car. Arrays have a row for each car,
``[K, ...]``.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import logit

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig
from pemviz.simulators.braking.scenario import car_salient
from pemviz.simulators.encounters.encounter_signals import (
    ASIDE,
    FALSE_POSITIVE,
    GAP,
    HEADING,
    SPEED,
    CarStates,
    ahead_in_lane,
)

NEAREST_M = 0.5
"""Ahead of the camera: what is nearer is taken for as near as that, or not seen at all."""
PARTLY, LARGELY, HIDDEN = 0.1, 0.5, 0.9
"""Occluded shares from which a car is partly occluded, largely occluded, and not to be seen."""
FALSE_POSITIVE_GAP = "ghost_gap"
"""Start value: where a ghost's place is."""


@dataclass(frozen=True)
class Sight:
    """Cars in the camera's frame, ``[K, ...]``.

    Attributes:
        x_m: Centre, to the right [m].
        z_m: Centre, ahead [m].
        truncated: Share of its width in the image that lies beyond the image.
        occluded: Share of the rest that nearer cars cover.
        present: Whether there is anything of it to be seen.
    """

    x_m: FloatArray
    z_m: FloatArray
    truncated: FloatArray
    occluded: FloatArray
    present: BoolArray


@dataclass(frozen=True, eq=False)
class EncounterSight:
    """Presence and salient variables at states ``[...]``, computed when first asked for.

    Attributes:
        config: The encounter.
        cars: Where the other cars are, ``[K, ...]``.
        false_positive_gap_m: The ghost's ``[...]`` [m], whose slot comes last, if there is one.
    """

    config: EncounterConfig
    cars: CarStates
    false_positive_gap_m: FloatArray | None = None

    @property
    def present(self) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[..., K]``."""
        return self._present

    @property
    def salient(self) -> FloatArray:
        """The slots' salient variables ``[..., K, 11]``; the ghost's are a car's in full view."""
        return self._salient

    @cached_property
    def _present(self) -> BoolArray:
        config, found = self.config, self._seen.present
        if (place_m := self.false_positive_gap_m) is not None:  # near enough, no car before it
            z_m = place_m + config.camera_to_bumper_m + config.car_length_m / 2
            before = ahead_in_lane(config, self.cars) & (self.cars.gap_m < place_m)
            own = (z_m > NEAREST_M) & (z_m <= config.farthest_m) & ~before.any(axis=0)
            found = np.concatenate([found, own[None]])
        return np.moveaxis(found, 0, -1)

    @cached_property
    def _salient(self) -> FloatArray:
        found = _salient(self.config, self._seen, self.cars.heading_rad)
        if self.false_positive_gap_m is not None:
            place_m = self.false_positive_gap_m[None]
            none = np.zeros_like(place_m)
            false_positive = _salient(self.config, seen(self.config, place_m, none), none)
            found = np.concatenate([found, false_positive])
        return np.moveaxis(found, 0, -2)

    @cached_property
    def _seen(self) -> Sight:
        return seen(self.config, self.cars.gap_m, self.cars.aside_m)


def seen(config: EncounterConfig, gap_m: FloatArray, aside_m: FloatArray) -> Sight:
    """Other cars, at gaps and offsets to the left ``[K, ...]`` [m], as the camera sees them."""
    near_m = gap_m + config.camera_to_bumper_m
    z_m = near_m + config.car_length_m / 2
    left, right = _image(config, near_m, aside_m)
    edge = float(np.tan(np.deg2rad(config.camera_half_angle_deg)))
    low, high = np.maximum(left, -edge), np.minimum(right, edge)
    width = (high - low).clip(0.0)
    in_front = z_m > NEAREST_M
    covered = np.zeros_like(width)
    for car in range(len(gap_m)):
        covers = [
            (np.maximum(low[car], left[other]), np.minimum(high[car], right[other]), hides)
            for other in range(len(gap_m))
            if other != car
            for hides in [in_front[other] & _is_nearer(near_m, other, car)]
        ]
        covered[car] = _length_of_union(covers)
    in_image = width > 0.0
    occluded = np.where(in_image, covered / np.where(in_image, width, 1.0), 0.0)
    return Sight(
        x_m=-aside_m,
        z_m=z_m,
        truncated=1.0 - width / (right - left),
        occluded=occluded,
        present=in_front & (z_m <= config.farthest_m) & in_image & (occluded < HIDDEN),
    )


def _image(
    config: EncounterConfig, near_m: FloatArray, aside_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where cars begin and end from left to right in the image, x / z, ``[K, ...]`` each."""
    near, far = near_m.clip(NEAREST_M), (near_m + config.car_length_m).clip(NEAREST_M)
    left_m, right_m = -aside_m - config.car_width_m / 2, -aside_m + config.car_width_m / 2
    left = np.minimum(left_m / near, left_m / far)
    return left, np.maximum(right_m / near, right_m / far)


def _is_nearer(near_m: FloatArray, other: int, car: int) -> BoolArray:
    return near_m[other] <= near_m[car] if other < car else near_m[other] < near_m[car]


def _length_of_union(covers: list[tuple[FloatArray, FloatArray, BoolArray]]) -> FloatArray | float:
    """What at most two intervals ``(low, high, counts)`` cover together, ``[...]``."""
    lengths = [np.where(counts, (high - low).clip(0.0), 0.0) for low, high, counts in covers]
    if len(covers) < 2:
        return sum(lengths, 0.0)
    (low, high, counts), (other_low, other_high, others) = covers
    both = (np.minimum(high, other_high) - np.maximum(low, other_low)).clip(0.0)
    overlap = counts & others & (lengths[0] > 0.0) & (lengths[1] > 0.0)
    return lengths[0] + lengths[1] - np.where(overlap, both, 0.0)


def _salient(config: EncounterConfig, sight: Sight, heading_rad: FloatArray) -> FloatArray:
    """Cars as KITTI would label them, ``[K, ..., 11]``."""
    return car_salient(
        x_m=sight.x_m,
        y_m=config.camera_height_m,
        z_m=sight.z_m,
        heading_rad=heading_rad,
        size_m=(config.car_height_m, config.car_width_m, config.car_length_m),
        truncated=sight.truncated,
        occlusion=np.add(sight.occluded >= PARTLY, sight.occluded >= LARGELY, dtype=np.float64),
    )


def displaced(
    config: EncounterConfig, gap_m: FloatArray, aside_m: FloatArray, errors_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Measured gaps and offsets ``[...]`` [m] of cars whose centres are off by errors.

    These are along the line of sight from the camera and across it to the right, ``[..., 2]``.
    """
    x_m = -aside_m
    z_m = gap_m + config.camera_to_bumper_m + config.car_length_m / 2
    distance_m = np.hypot(x_m, z_m)
    sine, cosine = x_m / distance_m, z_m / distance_m
    along, across = errors_m[..., 0], errors_m[..., 1]
    return gap_m + along * cosine - across * sine, aside_m - along * sine - across * cosine


@dataclass(frozen=True)
class FalsePositiveReports:
    """How likely perception reports a ghost, as a detector model: the same wherever one may be.

    Attributes:
        probability: At a step; above 0, below 1.
    """

    probability: float
    data = "false positives: a probability that was chosen"
    licence = "none needed"

    @property
    def name(self) -> str:
        """For results."""
        return f"false positives {self.probability:g}"

    @property
    def digest(self) -> str:
        """SHA-256 of the probability."""
        return hashlib.sha256(f"ghosts {self.probability!r}".encode()).hexdigest()

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of P(reported) ``[...]``, whatever the salient variables ``[..., D]``."""
        return np.full(salient.shape[:-1], logit(self.probability))


def false_positive_signals(place_m: FloatArray, ego_x_m: FloatArray) -> dict[str, FloatArray]:
    """The ghost's own signals ``[...]``: a car stands so far ahead of where the ego began."""
    none = np.zeros_like(ego_x_m)
    found = {GAP: place_m - ego_x_m, ASIDE: none, SPEED: none, HEADING: none}
    return {f"{what}_{FALSE_POSITIVE}": values for what, values in found.items()}
