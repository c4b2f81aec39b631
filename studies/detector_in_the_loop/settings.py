"""What the study asks: settings, how many rollouts and labelled frames, and where they are kept."""

from dataclasses import dataclass, replace

import numpy as np

from studies.detector_in_the_loop.scene import DOMAINS, Domain
from studies.detector_in_the_loop.worlds import BrakingWorld, CutInWorld, World

SEED = 20261126
TRAINING, VALIDATION, LABELLED, HELD_OUT, TRUTH, SPLITTING, WHY = range(7)
"""Purposes: scenes of one are never those of another."""
BLOCK = 500
"""Rollouts that are drawn together."""
ENOUGH = 400
"""Failures that give a probability within 10 %."""


def seeds(purpose: int, *place: int) -> np.random.SeedSequence:
    """The root of a purpose's randomness, or of a part of it."""
    return np.random.SeedSequence(SEED, spawn_key=(purpose, *place))


@dataclass(frozen=True)
class Setting:
    """A scenario, a domain and a threshold, whose failure probability is asked for.

    Attributes:
        name: In files and tables.
        world: The scenario.
        domain_name: Light and weather, of :data:`DOMAINS`.
        strict: How far the detector's threshold is from the usual one, in logits.
        rollouts: That are counted, unless ``ENOUGH`` fail before.
        levels_m: Of splitting; empty: plain rollouts are enough.
        particles: Of a run of splitting.
    """

    name: str
    world: World
    domain_name: str
    strict: float
    rollouts: int = 100_000
    levels_m: tuple[float, ...] = ()
    particles: int = 4_000

    @property
    def domain(self) -> Domain:
        """Light and weather."""
        return DOMAINS[self.domain_name]

    def threshold(self, usual: float) -> float:
        """Score from which on a detection counts."""
        logit = np.log(usual / (1.0 - usual)) + self.strict
        return float(1.0 / (1.0 + np.exp(-logit)))


@dataclass(frozen=True)
class Effort:
    """How much is done.

    Attributes:
        pictures: The detector is trained on.
        epochs: Of training.
        validation: Pictures of its curve and threshold.
        frames: Labelled, a prediction for each.
        frames_by_kind: Labelled, for a model of each kind of light and weather.
        share: Of the rollouts of each setting.
        scenes: To see why predictions are off.
        splitting_runs: Of each setting that splitting answers.
    """

    pictures: int = 24_000
    epochs: int = 12
    validation: int = 4_000
    frames: tuple[int, ...] = (1_000, 10_000, 100_000)
    frames_by_kind: int = 10_000
    share: float = 1.0
    scenes: int = 3_000
    splitting_runs: int = 8

    def rollouts_of(self, setting: Setting) -> int:
        """How many rollouts of a setting are counted at most."""
        return max(500, int(setting.rollouts * self.share))


WHOLE = Effort()
QUICK = replace(
    WHOLE, pictures=8_000, epochs=5, validation=1_000, frames=(2_000,), frames_by_kind=2_000,
    share=0.01, scenes=100, splitting_runs=2,
)  # fmt: skip


FAR = BrakingWorld(initial_gap_m=70.0, emergency_gap_m=60.0, speed_kmh=108.0)
"""108 km/h: what is detected 60 to 23 m away decides over the first five seconds."""
MIDDLE = BrakingWorld(
    initial_gap_m=45.0, emergency_gap_m=35.0, speed_kmh=72.0, lead_deceleration_mps2=5.0
)
"""72 km/h: likewise 35 to 23 m away."""

FAST = BrakingWorld(initial_gap_m=60.0, emergency_gap_m=50.0, speed_kmh=97.2)
SLOW = BrakingWorld(
    initial_gap_m=38.0, emergency_gap_m=28.0, speed_kmh=57.6, lead_deceleration_mps2=5.0
)
"""Speeds and distances that were stated before any prediction of them was looked at."""

SETTINGS = (
    Setting("far-fair", FAR, "fair", 1.2),
    Setting("far-rain", FAR, "rain", 0.6),
    Setting("far-fog", FAR, "fog", 0.0),
    Setting("middle-fair", MIDDLE, "fair", 1.2),
    Setting("middle-rain", MIDDLE, "rain", 0.6),
    Setting("middle-fog", MIDDLE, "fog", 0.0),
    Setting(
        "middle-rain-usual",
        MIDDLE,
        "rain",
        0.0,
        levels_m=(16.0, 12.0, 8.0, 4.0),
        particles=10_000,
    ),
    Setting("cut-in-fair", CutInWorld(), "fair", 1.2),
    Setting("fast-all", FAST, "all", 0.6),
    Setting("slow-all", SLOW, "all", 0.6),
)
"""All that is asked."""
