"""Whether what a simulator declares fits together: facts, latents, start values, slots, scene."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NoReturn, TypeVar

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.faults import SimulationError, exception_text, refused
from pemviz.latents import LatentCounts
from pemviz.simulators.latents import NamesStarts, latent_counts
from pemviz.simulators.scene import DrawsScene, DrawsTracks, Ramp, Road, SceneCar, SceneStates
from pemviz.simulators.slots import (
    ERROR,
    SLOT,
    ReactsInSlot,
    SaysWhereItReacts,
    SeesAtOnce,
    Slot,
    SlotSimulator,
)
from pemviz.types import CERTAIN, LAST, LAST_OUTCOME, Signal, StateBatch

Value = TypeVar("Value")

TAKEN_KEYS = (
    *("repetition", "stage", "detected", "log_p", "log_q", "robustness", "violated"),
    *("pem_logit", "proposal_logit"),
)
TAKEN_SIGNALS = (SLOT, LAST_OUTCOME.name)
TAKEN_MEMORY = (CERTAIN, ERROR, LAST)
TRIED_STARTS = 5
LEAST_LINES, LEAST_PLACES = 2, 2


@dataclass(frozen=True)
class Complaint:
    """Refuses a simulator in one line.

    Attributes:
        where: With what the line begins.
    """

    where: str

    def refuse(self, words: str, *, cause: BaseException | None = None) -> NoReturn:
        """Say what is wrong.

        Raises:
            ConfigError: Always.
        """
        refusal = ConfigError(f"{self.where}: {words}")
        raise refusal if cause is None else refused(refusal, cause) from cause

    def call(
        self, what: str, function: Callable[..., Value], *given: Any, about: str = ""
    ) -> Value:
        """What the user's code gives; what it raises, which may be anything, is refused.

        Raises:
            ConfigError: It raises something.
        """
        try:
            return function(*given)
        except BaseException as error:
            if isinstance(error, ConfigError) and not about:  # said in words already
                raise
            if isinstance(error, SimulationError) and error.__cause__ is None:
                raise ConfigError(str(error)) from error
            self.refuse(f"{what} raises {exception_text(error)}{about}", cause=error)


def check_facts(simulator: Any, complaint: Complaint) -> None:
    """Name, sizes, and signals with names and keys of their own."""
    if not isinstance(simulator.name, str) or not simulator.name.strip():
        Complaint("simulator").refuse(f"name = {simulator.name!r}: must be a text")
    if simulator.states < 2:  # one decision and what it leads to
        complaint.refuse(f"states = {simulator.states}: must be at least 2")
    if not 0.0 < simulator.dt_s < np.inf:
        complaint.refuse(f"dt_s = {simulator.dt_s}: must be above 0 and finite")
    signals: Sequence[Signal] = simulator.signals
    if not signals:
        complaint.refuse("signals is empty; specifications are about signals")
    for names, what in (([s.name for s in signals], "name"), ([s.key for s in signals], "key")):
        if len(set(names)) < len(names):
            complaint.refuse(f"two signals have the same {what}")
    for signal in signals:
        if not (signal.name.isidentifier() and signal.key.isidentifier()):
            complaint.refuse(f"signal {signal.name!r}: name and key must be identifiers")
        if signal.key in TAKEN_KEYS:
            complaint.refuse(f"signal {signal.name!r}: the key {signal.key!r} is taken")
        if not signal.low < signal.high:
            complaint.refuse(f"signal {signal.name!r}: low must be below high")


def check_counts(simulator: object, complaint: Complaint) -> None:
    """Latents are declared as whole numbers from 0."""
    declared = getattr(simulator, "latents", None)
    if declared is None:
        return
    if not isinstance(declared, LatentCounts):
        complaint.refuse(f"latents is a {type(declared).__name__}: must be pemviz.LatentCounts")
    for name in ("start", "noise", "seeds"):
        number = getattr(declared, name)
        if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 0:
            complaint.refuse(f"latents: {name} = {number!r}: must be a whole number from 0")


def check_starts(simulator: object, complaint: Complaint) -> None:
    """Names, plane and values of starts fit together.

    Values are finite, one for each rollout, and a rollout's own whatever is beside it.
    """
    if not isinstance(simulator, NamesStarts):
        return
    signals: Any = simulator.starts  # whatever the user's code has there
    if not (isinstance(signals, tuple) and signals and all(type(s) is Signal for s in signals)):
        complaint.refuse("starts must be a tuple of one pemviz.Signal at least")
    names = [signal.name for signal in signals]
    for words in (names, [signal.key for signal in signals]):
        if len(set(words)) < len(words) or not all(word.isidentifier() for word in words):
            complaint.refuse("starts: names and keys must be identifiers, each once")
    for signal in signals:
        if not (signal.low < signal.high and np.isfinite([signal.low, signal.high]).all()):
            complaint.refuse(f"starts: {signal.name}: low must be below high, both finite")
    plane = tuple(simulator.start_plane)
    if len(set(plane)) != 2 or not set(plane) <= set(names):
        complaint.refuse(f"start_plane = {plane!r}: must be two of {', '.join(names)}")

    def values_of(start: FloatArray) -> Mapping[str, FloatArray]:
        return complaint.call("start_values", simulator.start_values, start.copy())

    shape = TRIED_STARTS, latent_counts(simulator).start
    start = np.random.default_rng(2).standard_normal(shape)
    values, backwards = values_of(start), values_of(start[::-1])
    if set(values) != set(names):
        found, wanted = (", ".join(sorted(some)) for some in (values, names))
        complaint.refuse(f"start_values gives {found}: must give {wanted}")
    for name, one in values.items():
        if np.shape(one) != (TRIED_STARTS,) or np.asarray(one).dtype != np.float64:
            complaint.refuse(
                f"start_values: {name} has shape {np.shape(one)}: must be ({TRIED_STARTS},), "
                "of type float64"
            )
        if not np.isfinite(one).all():
            complaint.refuse(f"start_values: {name} must be finite numbers")
        if not np.allclose(one, backwards[name][::-1], rtol=1e-9, atol=0.0):
            complaint.refuse(f"start_values: {name} must not depend on the other rollouts")


def check_slots(simulator: SlotSimulator, complaint: Complaint) -> None:
    """Slots with names of their own, and signals that are there."""
    slots: Any = simulator.slots  # whatever the user's code has there
    if not isinstance(slots, tuple) or not all(isinstance(slot, Slot) for slot in slots):
        complaint.refuse("slots must be a tuple of pemviz.Slot")
    if not slots:
        complaint.refuse("slots is empty: must be one at least")
    for slot in slots:
        name, nominal, signals = slot.name, slot.nominal, slot.signals
        if not isinstance(name, str) or not name.isprintable():
            complaint.refuse(f"a slot has the name {name!r}: must be one line of text")
        if not isinstance(nominal, bool):
            complaint.refuse(f"slot {name!r} has nominal = {nominal!r}: must be True or False")
        if not isinstance(signals, tuple):
            complaint.refuse(f"slot {name!r} has signals = {signals!r}: must be a tuple of names")
    names = [slot.name for slot in slots]
    if len(set(names)) < len(names) or not all(name.strip() for name in names):
        complaint.refuse(f"slots are named {names}: each must have a name of its own")
    declared = {signal.name for signal in simulator.signals}
    for slot in slots:
        unknown = [name for name in slot.signals if name not in declared]
        if unknown:
            complaint.refuse(
                f"slot {slot.name!r} has the signals {unknown}: must be among {sorted(declared)}"
            )
    numbers = [len(slot.signals) for slot in slots]
    if len(set(numbers)) > 1:
        complaint.refuse(f"slots have {numbers} signals of their own: must be as many for each")
    taken = [name for name in TAKEN_SIGNALS if name in declared]
    if taken:
        complaint.refuse(f"the signal {taken[0]!r} is pemviz's own where there are slots")


def check_kept(start: StateBatch, complaint: Complaint) -> None:
    """States of a simulator with slots carry plain memory, under names of its own."""
    if type(start) is not StateBatch:
        complaint.refuse(f"initial gives a {type(start).__name__}: must be a pemviz.StateBatch")
    taken = [name for name in start.memory if name.startswith(TAKEN_MEMORY)]
    if taken:
        complaint.refuse(f"the memory {taken[0]!r} is pemviz's own; choose another name")


def check_sight(simulator: SlotSimulator, states: StateBatch, complaint: Complaint) -> None:
    """Shapes of salient variables and of presence at ``states [N]``."""

    def seen(signals: Mapping[str, FloatArray]) -> tuple[dict[str, BoolArray], FloatArray, str]:
        present, salient = simulator.present(signals), simulator.salient(signals)
        by_slot = {"present": present}
        if isinstance(simulator, SaysWhereItReacts):
            by_slot["reacts"] = simulator.reacts(signals)
        return by_slot, salient, _contradiction(simulator, signals)

    slots = len(simulator.slots)
    for signals, shape in _once_and_twice(states):
        what, about = "present, salient or reacts", f" (for signals of shape {shape})"
        by_slot, salient, other = complaint.call(what, seen, signals, about=about)
        for what, found in by_slot.items():
            if np.shape(found) != (*shape, slots) or np.asarray(found).dtype != np.bool_:
                complaint.refuse(
                    f"{what} gives {np.asarray(found).dtype} of shape {np.shape(found)} "
                    f"for signals of shape {shape}: must be bool of shape {(*shape, slots)}"
                )
        if np.ndim(salient) != len(shape) + 2 or np.shape(salient)[:-1] != (*shape, slots):
            complaint.refuse(
                f"salient gives shape {np.shape(salient)} for signals of shape {shape}: "
                f"must be {(*shape, slots)} and D variables"
            )
        if other:
            complaint.refuse(f"{other}: both must give the same, or rename the first")


def _contradiction(simulator: SlotSimulator, signals: Mapping[str, FloatArray]) -> str:
    """A method evaluated in place of others, and one of those, if the two differ."""
    if isinstance(simulator, SeesAtOnce):
        sight = simulator.sight(signals)
        if not np.array_equal(sight.present, simulator.present(signals)):
            return "sight and present differ"
        if not np.array_equal(sight.salient, simulator.salient(signals), equal_nan=True):
            return "sight and salient differ"
    if isinstance(simulator, ReactsInSlot) and isinstance(simulator, SaysWhereItReacts):
        each = [simulator.reacts_in(slot, signals) for slot in range(len(simulator.slots))]
        if not np.array_equal(np.stack(each, axis=-1), simulator.reacts(signals)):
            return "reacts_in and reacts differ"
    return ""


def check_scene(simulator: Any, states: StateBatch, complaint: Complaint) -> None:
    """Cars, road, places and tracks at ``states [N]``, where the simulator offers them."""
    slots = tuple(slot.name for slot in getattr(simulator, "slots", ()))
    if isinstance(simulator, DrawsScene):
        _check_cars(simulator.scene_cars, slots, complaint)
        _check_road(simulator.road, complaint)
        _check_places(simulator, states, complaint)
    if isinstance(simulator, DrawsTracks):
        _check_tracks(simulator, states, max(len(slots), 1), complaint)


def _check_cars(cars: Any, slots: tuple[str, ...], complaint: Complaint) -> None:
    if not isinstance(cars, tuple) or not cars or not all(isinstance(c, SceneCar) for c in cars):
        complaint.refuse("scene_cars must be a tuple of pemviz.SceneCar, the ego first")
    for car in cars:
        if not isinstance(car.name, str) or not car.name.strip() or not car.name.isprintable():
            complaint.refuse(f"a car of the scene is named {car.name!r}: must be a line of text")
        sizes = (car.length_m, car.width_m, car.height_m)
        if not all(isinstance(size, int | float) and 0.0 < size < np.inf for size in sizes):
            complaint.refuse(f"car {car.name!r} has the sizes {sizes}: must be above 0 and finite")
        if car.slot is not None and slots and car.slot not in slots:
            complaint.refuse(
                f"car {car.name!r} has the slot {car.slot!r}: must be one of {', '.join(slots)}"
            )
    names = [car.name for car in cars]
    if len(set(names)) < len(names):
        complaint.refuse(f"the scene's cars are named {names}: each must have a name of its own")


def _check_road(road: Any, complaint: Complaint) -> None:
    if not isinstance(road, Road):
        complaint.refuse(f"road is a {type(road).__name__}: must be a pemviz.Road")
    try:
        edges_m = np.asarray(road.lane_edges_m, dtype=np.float64)
    except (TypeError, ValueError):
        edges_m = np.empty(0)
    fine = edges_m.ndim == 1 and edges_m.size >= LEAST_LINES and np.isfinite(edges_m).all()
    if not fine or not (np.diff(edges_m) > 0.0).all():
        complaint.refuse(
            f"road has lane_edges_m = {road.lane_edges_m!r}: must be at least "
            f"{LEAST_LINES} finite numbers, ascending"
        )
    ramps: Any = road.ramps
    if not isinstance(ramps, tuple) or not all(isinstance(ramp, Ramp) for ramp in ramps):
        complaint.refuse(f"road has ramps = {ramps!r}: must be a tuple of pemviz.Ramp")
    for ramp in road.ramps:
        edges = (ramp.x_m, ramp.right_m, ramp.left_m)
        try:
            x_m, right_m, left_m = np.array(edges, dtype=np.float64)
        except (TypeError, ValueError):
            x_m = right_m = left_m = np.empty(0)
        fine = x_m.ndim == 1 and x_m.size >= LEAST_PLACES and np.isfinite([right_m, left_m]).all()
        if not fine or not (np.diff(x_m) > 0.0).all() or not (left_m > right_m).all():
            complaint.refuse(
                f"road has a ramp {ramp!r}: must have at least {LEAST_PLACES} places, x_m "
                "ascending and left_m above right_m, all finite"
            )


def _check_places(simulator: DrawsScene, states: StateBatch, complaint: Complaint) -> None:
    for signals, shape in _once_and_twice(states):
        about = f" (for signals of shape {shape})"
        drawn: Any = complaint.call("scene", simulator.scene, signals, about=about)
        if not isinstance(drawn, SceneStates):
            complaint.refuse(f"scene gives a {type(drawn).__name__}: must be a pemviz.SceneStates")
        of_cars = (*shape, len(simulator.scene_cars))
        _check_array(drawn.collided, "scene: collided", shape, np.bool_, complaint)
        _check_array(drawn.present, "scene: present", of_cars, np.bool_, complaint)
        for name in ("x_m", "y_m", "heading_rad", "speed_mps"):
            values = getattr(drawn, name)
            _check_array(values, f"scene: {name}", of_cars, np.float64, complaint)
            if not np.isfinite(values[drawn.present]).all():
                complaint.refuse(f"scene: {name} must be finite wherever a car is present")


def _check_tracks(
    simulator: DrawsTracks, states: StateBatch, slots: int, complaint: Complaint
) -> None:
    twice = states.map(lambda values: np.stack([values, values], axis=-1))
    for given in (states, replace(twice, step=states.step)):
        about, shape = f" (for signals of shape {given.shape})", (*given.shape, slots)
        drawn = complaint.call("scene_tracks", simulator.scene_tracks, given, about=about)
        confirmed = getattr(drawn, "confirmed", None)
        _check_array(confirmed, "scene_tracks: confirmed", shape, np.bool_, complaint)
        for name in ("x_m", "y_m", "x_sd_m", "y_sd_m"):
            values = getattr(drawn, name, None)
            _check_array(values, f"scene_tracks: {name}", shape, np.float64, complaint)
            known = np.asarray(values)[np.asarray(confirmed)]
            if not np.isfinite(known).all() or (name.endswith("_sd_m") and (known < 0.0).any()):
                least = " and at least 0" if name.endswith("_sd_m") else ""
                complaint.refuse(f"scene_tracks: {name} of a track must be finite{least}")


def _check_array(
    values: object, what: str, shape: tuple[int, ...], kind: type, complaint: Complaint
) -> None:
    found = np.asarray(values)
    if found.shape != shape or found.dtype != kind:
        complaint.refuse(
            f"{what} is {found.dtype} of shape {found.shape} for signals of shape "
            f"{shape if 'collided' in what else shape[:-1]}: must be {np.dtype(kind)} of shape "
            f"{shape}"
        )


def _once_and_twice(
    states: StateBatch,
) -> list[tuple[Mapping[str, FloatArray], tuple[int, ...]]]:
    """The signals ``[N]``, and each beside itself, ``[N, 2]``, with their shapes."""
    count, flat = states.shape[0], states.signals
    twice = {name: np.stack([values, values], axis=-1) for name, values in flat.items()}
    return [(flat, (count,)), (twice, (count, 2))]
