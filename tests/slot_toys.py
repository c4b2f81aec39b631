"""Scenarios with slots whose failure probabilities are known, from all joint outcomes of a step."""

import itertools
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.slots import Slot
from pemviz.types import Signal, StateBatch


def _walk_signal(name: str, high: int) -> Signal:
    return Signal(name=name, key=f"{name}_m", unit="m", low=-1.0, high=float(high))


@dataclass(frozen=True, kw_only=True)
class TwoCars:
    """Two gaps on the integers; the second car is in view only where it is near.

    A miss brings its car one nearer, a detection one away; with ``brakes_for_any``, both cars come
    nearer where both are missed (or absent), else go away.
    """

    starts: tuple[int, int] = (10, 11)
    largest: int = 12
    in_view: int = 9
    states: int = 21
    brakes_for_any: bool = False
    name: str = "two-cars"
    dt_s: float = 0.5

    @property
    def signals(self):
        return (_walk_signal("gap_a", self.largest), _walk_signal("gap_b", self.largest))

    @property
    def slots(self):
        return (Slot("car a", signals=("gap_a",)), Slot("car b", signals=("gap_b",)))

    def initial(self, *, count: int) -> StateBatch:
        start = zip(("gap_a", "gap_b"), self.starts, strict=True)
        signals = {name: np.full(count, float(gap)) for name, gap in start}
        return StateBatch(step=np.zeros((), dtype=np.int64), signals=signals)

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        away = detected
        if self.brakes_for_any:
            seen = detected & self.present(states.signals)
            away = np.broadcast_to(seen.any(axis=-1)[:, None], detected.shape)
        signals = {
            name: np.minimum(
                states.signals[name] + np.where(away[:, slot], 1.0, -1.0), self.largest
            )
            for slot, name in enumerate(("gap_a", "gap_b"))
        }
        return StateBatch(step=states.step + 1, signals=signals)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return np.stack([signals["gap_a"], signals["gap_b"]], axis=-1)[..., None]

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        near = signals["gap_b"] <= self.in_view
        return np.stack([np.ones_like(near), near], axis=-1)


@dataclass(frozen=True, kw_only=True)
class GhostBrake:
    """The ego slows down by one where a ghost is reported, else gains one up to its start.

    The car ahead comes nearer by one where it is missed. A ghost can appear only while the car is
    far, as in front of a near car nothing has room.
    """

    start_speed: int = 6
    start_gap: int = 11
    largest: int = 12
    room: int = 4
    states: int = 16
    name: str = "ghost-brake"
    dt_s: float = 0.1

    @property
    def signals(self):
        return (_walk_signal("speed", self.start_speed), _walk_signal("gap", self.largest))

    @property
    def slots(self):
        return (Slot("car"), Slot("ghost", nominal=False))

    def initial(self, *, count: int) -> StateBatch:
        signals = {
            "speed": np.full(count, float(self.start_speed)),
            "gap": np.full(count, float(self.start_gap)),
        }
        return StateBatch(step=np.zeros((), dtype=np.int64), signals=signals)

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        speed = states.signals["speed"] + np.where(detected[:, 1], -1.0, 1.0)
        gap = states.signals["gap"] + np.where(detected[:, 0], 1.0, -1.0)
        signals = {
            "speed": np.minimum(speed, float(self.start_speed)),
            "gap": np.minimum(gap, float(self.largest)),
        }
        return StateBatch(step=states.step + 1, signals=signals)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return np.stack([signals["gap"], signals["speed"]], axis=-1)[..., None]

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        room = signals["gap"] >= self.room
        return np.stack([np.ones_like(room), room], axis=-1)


@dataclass(frozen=True)
class LinearModel:
    """Logit of P(detected): at_zero + slope * x."""

    at_zero: float
    slope: float

    def logit(self, salient: FloatArray) -> FloatArray:
        return self.at_zero + self.slope * salient[..., 0]


CAMERA = LinearModel(3.0, -0.2)
GHOSTS = LinearModel(-5.0, 0.3)
"""The faster, the more ghosts."""


def joint_outcomes(simulator, state, models, last=None, rho=0.0):
    """All joint outcomes ``[K]`` of a step with their probabilities; the absent are nominal.

    With a memory the probability of an error is pulled towards the slot's ``last`` outcome.
    """
    signals = {name: np.array([value]) for name, value in state.items()}
    present = simulator.present(signals)[0]
    salient = simulator.salient(signals)[0]
    choices = []
    for slot, declared in enumerate(simulator.slots):
        if not present[slot]:
            choices.append([(declared.nominal, 1.0)])
            continue
        reported = float(expit(models[slot].logit(salient[slot])))
        error = 1.0 - reported if declared.nominal else reported
        if last is not None and last[slot] is not None:
            error += (float(last[slot]) - error) * rho
        choices.append([(declared.nominal, 1.0 - error), (not declared.nominal, error)])
    for combination in itertools.product(*choices):
        outcomes = tuple(outcome for outcome, _ in combination)
        yield outcomes, math.prod(chance for _, chance in combination), present


def exact_probability(simulator, models, is_unsafe, *, tau_s=0.0):
    """Forward over all states, joint outcomes and, with a memory, last outcomes of slots."""
    rho = math.exp(-simulator.dt_s / tau_s) if tau_s else 0.0
    first = {name: float(v[0]) for name, v in simulator.initial(count=1).signals.items()}
    mass = {(tuple(first.items()), (None,) * len(simulator.slots)): 1.0}
    failed = 0.0
    for step in range(simulator.states - 1):
        after = defaultdict(float)
        for (items, last), chance in mass.items():
            state = dict(items)
            outcomes = joint_outcomes(simulator, state, models, last if tau_s else None, rho)
            for chosen, probability, present in outcomes:
                moved = simulator.step(
                    StateBatch(np.array(step), {n: np.array([v]) for n, v in state.items()}),
                    np.array([chosen]),
                )
                reached = {name: float(values[0]) for name, values in moved.signals.items()}
                if is_unsafe(reached):
                    failed += chance * probability
                    continue
                errs = tuple(
                    out != slot.nominal if here else None
                    for out, slot, here in zip(chosen, simulator.slots, present, strict=True)
                )
                after[tuple(reached.items()), errs if tau_s else last] += chance * probability
        mass = after
    return failed
