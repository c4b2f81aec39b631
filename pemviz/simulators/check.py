"""Whether a simulator of somebody else's keeps to the protocol, told before a run starts."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.simulators.latched import VIOLATED
from pemviz.types import Signal, Simulator, StateBatch

Value = TypeVar("Value")

MEMBERS = ("name", "states", "dt_s", "signals", "initial", "step", "salient")
TAKEN_KEYS = ("repetition", "stage", "detected", "log_p", "log_q", "robustness", "violated")
COUNT = 3
OUTCOMES = np.array([True, False, True])
SECOND = slice(1, 2)


def check_simulator(simulator: Simulator) -> None:
    """Try the simulator on three rollouts of one step.

    Raises:
        ConfigError: One line: what is missing, of the wrong shape, or not pure.
    """
    absent = [member for member in MEMBERS if not hasattr(simulator, member)]
    if absent:
        kind = type(simulator).__name__
        message = f"simulator: {kind} is no pemviz.Simulator, it lacks {', '.join(absent)}"
        raise ConfigError(message)
    where = f"simulator {simulator.name!r}"
    _check_facts(simulator, where)
    first = _call(where, "initial", lambda: simulator.initial(count=COUNT))
    _check_states(first, simulator, f"{where}: initial(count={COUNT})", step=0)
    before = first.map(np.array)
    second = _call(where, "step", lambda: simulator.step(first, OUTCOMES))
    _check_states(second, simulator, f"{where}: step", step=1)
    if not _same(first, before):
        _refuse(f"{where}: step writes to the states it is given; it must return new ones")
    alone = _call(where, "step", lambda: simulator.step(first.take(SECOND), OUTCOMES[SECOND]))
    if not _same(second.take(SECOND), alone):
        _refuse(f"{where}: step must give a rollout the same again, whatever is beside it")
    _check_salient(simulator, second.signals, where)


def _check_facts(simulator: Simulator, where: str) -> None:
    if not simulator.name.strip():
        _refuse("simulator: name is empty")
    if simulator.states < 2:  # one decision and what it leads to
        _refuse(f"{where}: states = {simulator.states}: must be at least 2")
    if not 0.0 < simulator.dt_s < np.inf:
        _refuse(f"{where}: dt_s = {simulator.dt_s}: must be above 0 and finite")
    if not simulator.signals:
        _refuse(f"{where}: signals is empty; specifications are about signals")
    _check_names(simulator.signals, where)


def _check_names(signals: tuple[Signal, ...], where: str) -> None:
    for names, what in (([s.name for s in signals], "name"), ([s.key for s in signals], "key")):
        if len(set(names)) < len(names):
            _refuse(f"{where}: two signals have the same {what}")
    for signal in signals:
        if not (signal.name.isidentifier() and signal.key.isidentifier()):
            _refuse(f"{where}: signal {signal.name!r}: name and key must be identifiers")
        if signal.key in TAKEN_KEYS:
            _refuse(f"{where}: signal {signal.name!r}: the key {signal.key!r} is taken")
        if not signal.low < signal.high:
            _refuse(f"{where}: signal {signal.name!r}: low must be below high")


def _check_states(states: StateBatch, simulator: Simulator, where: str, *, step: int) -> None:
    if np.ndim(states.step) != 0 or int(states.step) != step:
        _refuse(f"{where}: step is {states.step!r}: must be one number for the batch, here {step}")
    declared = {signal.name for signal in simulator.signals}
    if set(states.signals) != declared:
        _refuse(f"{where}: signals are {sorted(states.signals)}, declared {sorted(declared)}")
    if VIOLATED in states.memory:
        _refuse(f"{where}: the memory {VIOLATED!r} is pemviz's own; choose another name")
    for name, values in {**states.signals, **states.memory}.items():
        if np.shape(values) != (COUNT,):
            _refuse(f"{where}: {name} has shape {np.shape(values)}: must be ({COUNT},)")
    for name, values in states.signals.items():
        if values.dtype != np.float64 or not np.isfinite(values).all():
            _refuse(f"{where}: {name} must be finite numbers of type float64")


def _check_salient(simulator: Simulator, signals: Mapping[str, FloatArray], where: str) -> None:
    twice = {name: np.stack([values, values], axis=1) for name, values in signals.items()}
    flat = np.shape(_call(where, "salient", lambda: simulator.salient(signals)))
    nested = np.shape(_call(where, "salient", lambda: simulator.salient(twice)))
    if len(flat) != 2 or flat[0] != COUNT or nested != (COUNT, 2, flat[1]):
        _refuse(
            f"{where}: salient gives shapes {flat} and {nested} for signals of shapes ({COUNT},) "
            f"and ({COUNT}, 2): must be ({COUNT}, D) and ({COUNT}, 2, D)"
        )


def _call(where: str, what: str, call: Callable[[], Value]) -> Value:
    try:
        return call()
    except Exception as error:  # the user's code may raise anything
        message = f"{where}: {what} raises {type(error).__name__}: {error}"
        raise ConfigError(" ".join(message.split())) from error


def _same(one: StateBatch, other: StateBatch) -> bool:
    pairs: list[tuple[AnyArray, AnyArray]] = [(one.step, other.step)]
    pairs += [(values, other.signals[name]) for name, values in one.signals.items()]
    pairs += [(values, other.memory[name]) for name, values in one.memory.items()]
    # objects, such as copies of an environment, need not know how to compare
    return all(np.array_equal(a, b) for a, b in pairs if a.dtype != np.object_)


def _refuse(message: str) -> None:
    raise ConfigError(message)
