"""Systems of one's own for the study of trust: what fails in two ways, and a drone at a wall."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import logit
from scipy.stats import binom

from pemviz.arrays import BoolArray, FloatArray
from pemviz.types import Signal, StateBatch

GAP, UNSEEN = "gap", "unseen"
CLOCK, MOST = "clock", "most"
WINDOW = 6
"""Steps of each window of time."""


@dataclass(frozen=True, kw_only=True)
class TwoWayWalk:
    """A walk on the integers: a miss leads one nearer to 0, a detection one away from it.

    It fails where it arrives at 0. It also fails, at its last state and without a sign before, if
    perception missed at all of some steps: a chain to which nothing that robustness or a signal
    shows leads.

    Attributes:
        watched: If all of these steps were missed, the gap is 0 at the last state.
        still: Before this step the gap does not move.
        initial_gap: Where the walk starts.
        largest_gap: Detections do not lead beyond it.
        states: States in a rollout.
        name: The simulator's.
        dt_s: Time step [s].
    """

    watched: tuple[int, ...] = ()
    still: int = 0
    initial_gap: int = 6
    largest_gap: int = 8
    states: int = 19
    name: str = "two-way-walk"
    dt_s: float = 1.0

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The gap alone."""
        return (Signal(name=GAP, key="gap_m", unit="m", low=-30.0, high=float(self.largest_gap)),)

    def initial(self, *, count: int) -> StateBatch:
        """``count`` walks at the start."""
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={GAP: np.full(count, float(self.initial_gap))},
            memory={UNSEEN: np.full(count, bool(self.watched))},
        )

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """One step nearer where missed ``[N]``, one away where detected."""
        step = int(states.step)
        gap, unseen = states.signals[GAP], states.memory[UNSEEN]
        if step >= self.still:
            gap = np.minimum(gap + np.where(detected, 1.0, -1.0), float(self.largest_gap))
        if step in self.watched:
            unseen = unseen & ~detected
        if step == self.states - 2:
            gap = np.where(unseen, 0.0, gap)
        return StateBatch(step=states.step + 1, signals={GAP: gap}, memory={UNSEEN: unseen})

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The gap, ``[..., 1]``."""
        return signals[GAP][..., None]


@dataclass(frozen=True)
class LinearLogit:
    """A detector model whose logit is linear in the one salient variable.

    Attributes:
        at_zero: The logit of 'detected' at 0.
        slope: Its change for each unit.
    """

    at_zero: float
    slope: float

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]`` for salient variables ``[..., 1]``."""
        return self.at_zero + self.slope * salient[..., 0]


@dataclass(frozen=True, kw_only=True)
class ScatteredMisses:
    """It fails where enough of any of several sets of steps are missed, wherever in time they lie.

    Between them every step is alike: nothing leads to a set, and a chain of errors that misses
    elsewhere too is improbable for nothing.

    Attributes:
        sets: Steps of each.
        needed: How many of a set's.
        states: States in a rollout.
        name: The simulator's.
        dt_s: Time step [s].
    """

    sets: tuple[tuple[int, ...], ...]
    needed: int
    states: int = 120
    name: str = "scattered-misses"
    dt_s: float = 1.0

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The step, and the most misses of any set so far."""
        return (
            Signal(name=CLOCK, key=CLOCK, unit="1", low=0.0, high=float(self.states)),
            Signal(name=MOST, key=MOST, unit="1", low=0.0, high=float(self.needed)),
        )

    @property
    def spec(self) -> str:
        """That of no set as many are missed as it takes."""
        return f"always[0,{self.states - 1}] ({MOST} < {self.needed})"

    def initial(self, *, count: int) -> StateBatch:
        """``count`` rollouts at their first step."""
        none = np.zeros(count)
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={CLOCK: none, MOST: none},
            memory={f"of set {number}": none for number in range(len(self.sets))},
        )

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """One miss more of each set that the step is in, where it was missed ``[N]``."""
        step = int(states.step)
        misses = {
            name: known + (~detected if step in steps else 0.0)
            for (name, known), steps in zip(states.memory.items(), self.sets, strict=True)
        }
        most = np.maximum.reduce(list(misses.values()))
        signals = {CLOCK: states.signals[CLOCK] + 1.0, MOST: most}
        return StateBatch(step=states.step + 1, signals=signals, memory=misses)

    def is_in_a_set(self, step: int) -> bool:
        """Whether a step is in one of the sets."""
        return any(step in steps for steps in self.sets)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The step, ``[..., 1]``."""
        return signals[CLOCK][..., None]

    def probability(self, *, miss: float) -> float:
        """Of a violation, where each step of a set is missed with the probability ``miss``."""
        of_each = [binom.sf(self.needed - 1, len(steps), miss) for steps in self.sets]
        return float(-np.expm1(np.sum(np.log1p(-np.array(of_each)))))


def windows(*first: int) -> ScatteredMisses:
    """Windows of time that begin at these steps; all steps of any are missed where it fails."""
    sets = tuple(tuple(range(step, step + WINDOW)) for step in first)
    return ScatteredMisses(sets=sets, needed=WINDOW)


@dataclass(frozen=True, kw_only=True)
class MissesInSets:
    """A detector model of :class:`ScatteredMisses`.

    Attributes:
        system: Whose sets.
        within: P(miss) at a step of one.
        elsewhere: At any other.
    """

    system: ScatteredMisses
    within: float = 0.05
    elsewhere: float = 0.1

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]`` at steps ``[..., 1]``."""
        steps = np.arange(self.system.states)
        inside = np.array([self.system.is_in_a_set(step) for step in steps.tolist()])
        miss = np.where(inside, self.within, self.elsewhere)
        return logit(1.0 - miss)[salient[..., 0].astype(np.int64)]


@dataclass(frozen=True)
class DroneAtWall:
    """A drone that hovers 2 m from a wall in wind, as ``examples/own_system.py`` has it."""

    name: str = "drone-at-wall"
    states: int = 61
    dt_s: float = 0.1
    signals: tuple[Signal, ...] = (
        Signal(name="distance", key="distance_m", unit="m", low=-20.0, high=20.0),
        Signal(name="approach", key="approach_mps", unit="m/s", low=-20.0, high=20.0),
    )

    def initial(self, *, count: int) -> StateBatch:
        """``count`` drones at rest."""
        start = {"distance": np.full(count, 2.0), "approach": np.zeros(count)}
        return StateBatch(step=np.zeros((), dtype=np.int64), signals=start)

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """It holds its distance where it sees the wall ``[N]``, and drifts where it does not."""
        distance_m, approach_mps = states.signals["distance"], states.signals["approach"]
        wanted_mps2 = np.clip(2.0 * (distance_m - 2.0) - 2.5 * approach_mps, -3.0, 1.0)
        total_mps2 = np.where(detected, wanted_mps2, 0.0) + 0.8
        later = {
            "distance": distance_m - approach_mps * self.dt_s,
            "approach": approach_mps + total_mps2 * self.dt_s,
        }
        return StateBatch(step=states.step + 1, signals=later)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The distance, ``[..., 1]``."""
        return signals["distance"][..., None]
