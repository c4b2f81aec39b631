"""A ghost: a place in the ego's lane that perception may take for a standing car."""

import hashlib
from dataclasses import dataclass

import numpy as np
from scipy.special import logit

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters.margins import is_ahead_in_lane
from pemviz.simulators.encounters.names import ASIDE, GAP, GHOST, HEADING, SPEED
from pemviz.simulators.encounters.sight import NEAREST_M, salient, seen

GHOST_GAP = "ghost_gap"
"""Start value: where the place is."""


@dataclass(frozen=True)
class GhostReports:
    """How likely perception reports a ghost: the same wherever there may be one.

    Attributes:
        probability: At a step; above 0, below 1.
    """

    probability: float

    @property
    def name(self) -> str:
        """For results."""
        return f"ghosts {self.probability:g}"

    @property
    def digest(self) -> str:
        """SHA-256 of the probability."""
        return hashlib.sha256(f"ghosts {self.probability!r}".encode()).hexdigest()

    @property
    def data(self) -> str:
        """What it rests on."""
        return "ghosts: a probability that was chosen"

    @property
    def licence(self) -> str:
        """Terms of its use."""
        return "none needed"

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of P(reported) ``[...]``, whatever the salient variables ``[..., D]``."""
        return np.full(salient.shape[:-1], logit(self.probability))


def ghost_signals(ghost_gap_m: FloatArray, ego_x_m: FloatArray) -> dict[str, FloatArray]:
    """The ghost's own signals: a car that stands at its place, ``[...]``.

    Args:
        ghost_gap_m: How far ahead of the ego's bumper the place is at s_0 [m].
        ego_x_m: How far the ego has come since [m].
    """
    none = np.zeros_like(ego_x_m)
    found = {GAP: ghost_gap_m - ego_x_m, ASIDE: none, SPEED: none, HEADING: none}
    return {f"{what}_{GHOST}": values for what, values in found.items()}


def may_appear(
    config: EncounterConfig, ghost_gap_m: FloatArray, gap_m: FloatArray, aside_m: FloatArray
) -> BoolArray:
    """Whether the place is in view, ``[...]``: near enough, with no car ahead in lane before it.

    Args:
        config: The encounter.
        ghost_gap_m: From bumper to place, ``[...]`` [m].
        gap_m: The other cars' gaps, ``[K, ...]`` [m].
        aside_m: Their offsets, likewise.
    """
    z_m = ghost_gap_m + config.camera_to_bumper_m + config.car_length_m / 2
    before = is_ahead_in_lane(config, gap_m, aside_m) & (gap_m < ghost_gap_m)
    return (z_m > NEAREST_M) & (z_m <= config.farthest_m) & ~before.any(axis=0)


def ghost_salient(config: EncounterConfig, ghost_gap_m: FloatArray) -> FloatArray:
    """Salient variables of a car that stood there, in full view, ``[1, ..., 11]``."""
    place, none = ghost_gap_m[None], np.zeros_like(ghost_gap_m)[None]
    return salient(config, seen(config, place, none), none)
