"""One rollout as views draw it: where its cars are, what perception reported, where it tracks.

All of it is a function of the states and outcomes that files hold; what a tracker remembers is in
no file, and comes back by simulating the rollout again from its outcomes and latents.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.simulators.latents import begun, stepped, within
from pemviz.simulators.scene import DrawsTracks, Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.slots import Slot, SlotSimulator
from pemviz.types import Simulator, StateBatch

NOT_EVALUATED, RIGHT, WRONG = 0, 1, 2
"""Of perception about a slot at a step: nothing to report, no error, an error."""
IMPACT_SPEED = "impact_speed"
"""Signal that says how fast the cars touched [m/s], where a scenario has it."""
WHOLE = Slot("perception")
"""Of a scenario without slots."""


@dataclass(frozen=True, eq=False)
class DrawnRollout:
    """One rollout of T states with C cars and K slots.

    Attributes:
        cars: The C cars, the ego first.
        road: What they drive on.
        states: Where they are, ``[T, C]``.
        slots: The K slots; one, named ``perception``, where a scenario has none.
        answers: ``[T-1, K]`` :data:`NOT_EVALUATED`, :data:`RIGHT` or :data:`WRONG`.
        slot_of_car: Each car's place among the slots; ``None`` where it has none.
        tracks: Where the controller believes the slots' cars to be, ``[T, K]``, if that is known.
        dt_s: Time step [s].
        contact_step: The state in which the ego first touches a car; ``None``: it never does.
        impact_speed_mps: How fast they touched [m/s]; ``None``: never, or not known.
    """

    cars: tuple[SceneCar, ...]
    road: Road
    states: SceneStates
    slots: tuple[Slot, ...]
    answers: IntArray
    slot_of_car: tuple[int | None, ...]
    tracks: SceneTracks | None
    dt_s: float
    contact_step: int | None
    impact_speed_mps: float | None

    @property
    def count(self) -> int:
        """Number of states T."""
        return int(self.states.collided.size)

    def answer_about(self, car: int) -> IntArray:
        """``[T]`` what perception reported of a car; nothing at the end and from contact on."""
        answers = np.full(self.count, NOT_EVALUATED, dtype=np.int64)
        slot = self.slot_of_car[car]
        if slot is not None:
            answers[:-1] = self.answers[:, slot]
        answers[self.count if self.contact_step is None else self.contact_step :] = NOT_EVALUATED
        return answers

    def car_of_slot(self, slot: int) -> SceneCar:
        """The car that a slot is about; the ego's shape where there is none, as of a ghost."""
        return self.cars[self.slot_of_car.index(slot) if slot in self.slot_of_car else 0]

    @property
    def contact_words(self) -> str:
        """When and how fast the ego touched a car; empty if it did not."""
        if self.contact_step is None:
            return ""
        words = f"contact at {self.contact_step * self.dt_s:.2f} s"
        speed = self.impact_speed_mps
        return words if speed is None else f"{words}, impact at {speed:.1f} m/s"


def answer_words(slot: Slot, answer: int) -> str:
    """What perception reported of a slot: ``detected``, ``MISSED``, ``FALSE POSITIVE`` ..."""
    if answer == NOT_EVALUATED:
        return "not in view" if slot.nominal else "no false positive"
    if answer == RIGHT:
        return "detected" if slot.nominal else "no false positive"
    return "MISSED" if slot.nominal else "FALSE POSITIVE"


def drawn_rollout(
    simulator: Simulator | SlotSimulator,
    *,
    signals: Mapping[str, FloatArray],
    detected: BoolArray,
    memory: Mapping[str, AnyArray],
) -> DrawnRollout | None:
    """A rollout as views draw it; ``None`` where its scenario does not say where its cars are.

    Args:
        simulator: The scenario, in its own steps.
        signals: ``[T]`` by name.
        detected: Outcomes ``[T-1]``, with several slots ``[T-1, K]``.
        memory: What its states remember, ``[T]`` by name; without it no tracks are drawn.
    """
    scene = drawn_scene(simulator)
    if scene is None:
        return None
    tracks, scene_with_tracks = None, within(simulator, DrawsTracks)
    if scene_with_tracks is not None and memory:
        steps = np.arange(next(iter(signals.values())).size)
        course = StateBatch(step=steps, signals=signals, memory=memory)
        tracks = scene_with_tracks.scene_tracks(course)
    states = scene.scene(signals)
    slots = slots_of(simulator)
    places: dict[str | None, int] = {slot.name: place for place, slot in enumerate(slots)}
    slot_of_car = tuple(places.get(car.slot) for car in scene.scene_cars)
    if not slots:  # perception answers for the car ahead
        slot_of_car = tuple(0 if car == 1 else None for car in range(len(scene.scene_cars)))
    contact = np.flatnonzero(states.collided)
    contact_step = int(contact[0]) if contact.size else None
    impact_mps = signals.get(IMPACT_SPEED, states.impact_speed_mps)
    return DrawnRollout(
        cars=scene.scene_cars,
        road=scene.road,
        states=states,
        slots=slots or (WHOLE,),
        answers=slot_answers(simulator, signals=signals, detected=detected),
        slot_of_car=slot_of_car,
        tracks=tracks,
        dt_s=simulator.dt_s,
        contact_step=contact_step,
        impact_speed_mps=None
        if contact_step is None or impact_mps is None
        else float(impact_mps[contact_step]),
    )


def slot_answers(
    simulator: Simulator | SlotSimulator,
    *,
    signals: Mapping[str, FloatArray],
    detected: BoolArray,
) -> IntArray:
    """What perception reported of each slot in a rollout, ``[T-1, K]``, arguments as above."""
    outcomes = detected.reshape(len(detected), -1)
    if not isinstance(simulator, SlotSimulator):
        return np.where(outcomes, RIGHT, WRONG)
    nominal = np.array([slot.nominal for slot in simulator.slots], dtype=np.bool_)
    present = np.asarray(simulator.present(signals))[:-1]
    return np.where(present, np.where(outcomes == nominal, RIGHT, WRONG), NOT_EVALUATED)


def remembered(
    simulator: Simulator | SlotSimulator,
    *,
    detected: BoolArray,
    start: FloatArray | None = None,
    noise: FloatArray | None = None,
) -> Mapping[str, AnyArray]:
    """What a rollout's states remember, ``[T]`` by name, by simulating it again.

    Args:
        simulator: The scenario, in its own steps; one whose states can be gone on from.
        detected: Outcomes ``[T-1]``, with several slots ``[T-1, K]``.
        start: Latents at the start, ``[S]``.
        noise: Latents of its steps, ``[T-1, M]``.
    """
    states = begun(simulator, count=1, start=None if start is None else start[None])
    outcomes = detected
    if isinstance(simulator, SlotSimulator):
        outcomes = detected.reshape(len(detected), len(simulator.slots))
    course = [states]
    for step, outcome in enumerate(outcomes):
        given = None if noise is None else noise[None, step]
        states = stepped(simulator, states, outcome[None], given)
        course.append(states)
    return {name: np.concatenate([one.memory[name] for one in course]) for name in states.memory}


def slots_of(simulator: Simulator | SlotSimulator) -> tuple[Slot, ...]:
    """The scenario's slots; none where perception answers one thing a step."""
    return simulator.slots if isinstance(simulator, SlotSimulator) else ()


def faultless(detected: BoolArray, *, slots: Sequence[Slot]) -> BoolArray:
    """Whether no slot errs, ``[..., T-1]`` of outcomes ``[..., T-1]``, with K slots ``[..., K]``.

    Without any, an outcome of False is an error.
    """
    if not slots:
        return detected
    right = detected == _nominal(slots)
    return np.all(right, axis=-1) if len(slots) > 1 else right


def right_by_slot(detected: BoolArray, *, slots: Sequence[Slot]) -> Mapping[str, BoolArray]:
    """Whether each of several slots does not err, ``[T-1]`` by name of a rollout's ``[T-1, K]``."""
    if len(slots) < 2:
        return {}
    right = detected == _nominal(slots)
    return {slot.name: np.array(right[:, place]) for place, slot in enumerate(slots)}


def faultless_probability(logit: FloatArray, *, slots: Sequence[Slot]) -> FloatArray:
    """Probability that no slot errs, by logits of 'detected', shaped as outcomes are there."""
    if not slots:
        return np.asarray(expit(logit))
    right = np.asarray(expit(np.where(_nominal(slots), logit, -logit)))
    return np.prod(right, axis=-1) if len(slots) > 1 else right


def _nominal(slots: Sequence[Slot]) -> BoolArray:
    nominal = np.array([slot.nominal for slot in slots], dtype=np.bool_)
    return nominal if len(slots) > 1 else nominal[0]
