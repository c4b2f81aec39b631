"""What a simulator with slots must keep to beyond what every simulator must."""

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.faults import told
from pemviz.simulators.slots import (
    ERROR,
    SLOT,
    ReactsInSlot,
    SaysWhereItReacts,
    SeesAtOnce,
    Slot,
    SlotSimulator,
)
from pemviz.types import CERTAIN, LAST, LAST_OUTCOME, StateBatch

TAKEN = (SLOT, LAST_OUTCOME.name)
TAKEN_MEMORY = (CERTAIN, ERROR, LAST)


def check_slots(simulator: SlotSimulator, where: str) -> None:
    """The declaration: slots with names of their own, and signals that are there.

    Raises:
        ConfigError: One line, which begins with ``where``.
    """
    slots = simulator.slots
    if not _is_slots(slots):
        _refuse(f"{where}: slots must be a tuple of pemviz.Slot")
    if not slots:
        _refuse(f"{where}: slots is empty: must be one at least")
    for slot in slots:
        _check_slot(slot, where)
    names = [slot.name for slot in slots]
    if len(set(names)) < len(names) or not all(name.strip() for name in names):
        _refuse(f"{where}: slots are named {names}: each must have a name of its own")
    declared = {signal.name for signal in simulator.signals}
    for slot in slots:
        unknown = [name for name in slot.signals if name not in declared]
        if unknown:
            _refuse(
                f"{where}: slot {slot.name!r} has the signals {unknown}: must be among "
                f"{sorted(declared)}"
            )
    numbers = [len(slot.signals) for slot in slots]
    if len(set(numbers)) > 1:
        _refuse(f"{where}: slots have {numbers} signals of their own: must be as many for each")
    taken = [name for name in TAKEN if name in declared]
    if taken:
        _refuse(f"{where}: the signal {taken[0]!r} is pemviz's own where there are slots")


def _check_slot(slot: Any, where: str) -> None:
    """What a slot says of itself, which Python does not check."""
    name, nominal, signals = slot.name, slot.nominal, slot.signals
    if not isinstance(name, str) or not name.isprintable():
        _refuse(f"{where}: a slot has the name {name!r}: must be one line of text")
    if not isinstance(nominal, bool):
        _refuse(f"{where}: slot {name!r} has nominal = {nominal!r}: must be True or False")
    if not isinstance(signals, tuple):
        _refuse(f"{where}: slot {name!r} has signals = {signals!r}: must be a tuple of names")


def _is_slots(declared: object) -> bool:
    """Whether this is a tuple of slots."""
    return isinstance(declared, tuple) and all(isinstance(slot, Slot) for slot in declared)


def check_kept(start: StateBatch, where: str) -> None:
    """What states carry beside signals: plain memory, under names of its own.

    Raises:
        ConfigError: One line, which begins with ``where``.
    """
    if type(start) is not StateBatch:
        _refuse(f"{where}: initial gives a {type(start).__name__}: must be a pemviz.StateBatch")
    taken = [name for name in start.memory if name.startswith(TAKEN_MEMORY)]
    if taken:
        _refuse(f"{where}: the memory {taken[0]!r} is pemviz's own; choose another name")


def check_asked(simulator: SlotSimulator, states: StateBatch, where: str) -> None:
    """Shapes of salient variables and of presence at ``states [N]``.

    Raises:
        ConfigError: One of them is of the wrong shape or type.
    """
    slots = len(simulator.slots)
    flat, count = states.signals, states.shape[0]
    twice = {name: np.stack([values, values], axis=1) for name, values in flat.items()}
    for signals, shape in ((flat, (count,)), (twice, (count, 2))):
        try:
            present, salient = simulator.present(signals), simulator.salient(signals)
            reacts = present
            if isinstance(simulator, SaysWhereItReacts):
                reacts = simulator.reacts(signals)
            other = _told_otherwise(simulator, signals)
        except BaseException as error:  # the user's code may raise anything
            message = (
                f"{where}: present, salient or reacts raises {told(error)} (for signals of shape "
                f"{shape})"
            )
            raise ConfigError(message) from error
        for what, found in (("present", present), ("reacts", reacts)):
            if np.shape(found) != (*shape, slots) or np.asarray(found).dtype != np.bool_:
                _refuse(
                    f"{where}: {what} gives {np.asarray(found).dtype} of shape {np.shape(found)} "
                    f"for signals of shape {shape}: must be bool of shape {(*shape, slots)}"
                )
        if np.ndim(salient) != len(shape) + 2 or np.shape(salient)[:-1] != (*shape, slots):
            _refuse(
                f"{where}: salient gives shape {np.shape(salient)} for signals of shape {shape}: "
                f"must be {(*shape, slots)} and D variables"
            )
        if other is not None:
            _refuse(f"{where}: {other}: both must give the same, or rename the first")


def _told_otherwise(simulator: SlotSimulator, signals: Mapping[str, FloatArray]) -> str | None:
    """A method asked in place of others, and one of those, if the two differ at ``signals``."""
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
    return None


def check_ever_present(simulator: SlotSimulator, course: Sequence[StateBatch], where: str) -> None:
    """Perception must have something to answer, somewhere along whole rollouts.

    Raises:
        ConfigError: It has not.
    """
    if not any(simulator.present(states.signals).any() for states in course[:-1]):
        _refuse(f"{where}: no slot is ever present: perception would have nothing to answer")


def outcomes_by_slot(simulator: SlotSimulator, states: StateBatch, nominal: BoolArray) -> BoolArray:
    """Outcomes ``[N, K]`` from whether they are nominal ``[N]``; of the absent they always are.

    At every third step only one slot errs where they are not, each in its turn.

    Raises:
        ConfigError: ``present`` gives another shape than at the start.
    """
    slots, step = simulator.slots, int(states.step)
    present, shape = np.asarray(simulator.present(states.signals)), (nominal.size, len(slots))
    if present.shape != shape:
        _refuse(
            f"simulator {simulator.name!r}: present gives shape {present.shape} at step {step}: "
            f"must be {shape}"
        )
    errs = np.full(len(slots), step % 3 > 0)
    errs[step // 3 % len(slots)] = True
    error = ~nominal[:, None] & errs & present
    return error ^ np.array([slot.nominal for slot in slots], dtype=np.bool_)


def _refuse(message: str) -> NoReturn:
    raise ConfigError(message)
