"""Whether a simulator of somebody else's keeps to the protocol, told before a run starts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NoReturn, TypeVar

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.faults import SimulationError, told
from pemviz.latents import StandardNormals
from pemviz.simulators.absorbing import VIOLATED, violated_rule
from pemviz.simulators.check_latents import check_counts, tried_normals
from pemviz.simulators.check_scene import check_scene
from pemviz.simulators.check_slots import (
    check_asked,
    check_ever_present,
    check_kept,
    check_slots,
    outcomes_by_slot,
)
from pemviz.simulators.episodic import episodic, kept_memory
from pemviz.simulators.latents import begun, stepped
from pemviz.simulators.slots import SlotSimulator
from pemviz.simulators.starts import check_starts
from pemviz.simulators.tracking.tracker import tracker_of
from pemviz.types import Signal, Simulator, StateBatch

Value = TypeVar("Value")

MEMBERS = ("name", "states", "dt_s", "signals", "initial", "step", "salient")
TAKEN_KEYS = (
    *("repetition", "stage", "detected", "log_p", "log_q", "robustness", "violated"),
    *("pem_logit", "proposal_logit"),
)
ROUNDING = 1e-9
"""Of a signal's range: what a value may differ by when it is computed beside others."""
ALL_MISSED, ALL_DETECTED, MIXED, MIXED_AGAIN = range(4)
COUNT = 4
DECLARE = "what is random about it is declared: latents = pemviz.LatentCounts(start=1)"
COMPLETE = "; all that decides how a rollout goes on must be in signals and memory"


def check_simulator(simulator: Simulator | SlotSimulator) -> None:
    """Try the simulator on whole rollouts: missed, detected, and mixed outcomes twice.

    They are carried to the end three times: together; together in reverse order; and one of
    them alone, from the start and from a state that was kept in the middle. All must agree,
    since methods continue from kept states, and results must not depend on batches.
    Where slots are declared, "missed" is an error in every slot, and now and then in one alone.
    Where latents are, each rollout has its own, but for the two with the same outcomes.
    Episodes, which cannot be gone on with, are tried twice with the same mixed outcomes.

    Raises:
        ConfigError: One line: what is missing, of the wrong shape, not pure, or random.
    """
    if isinstance(simulator, type):
        name = simulator.__name__
        _refuse(f"simulator: {name} is a class: give an instance of it, such as {name}()")
    members = (*MEMBERS, "present") if hasattr(simulator, "slots") else MEMBERS
    absent = [member for member in members if not hasattr(simulator, member)]
    if absent:
        kind = type(simulator).__name__
        _refuse(f"simulator: {kind} is no pemviz.Simulator, it lacks {', '.join(absent)}")
    where = f"simulator {simulator.name!r}"
    _check_facts(simulator, where)
    check_counts(simulator, where)
    check_starts(simulator, where)
    if isinstance(simulator, SlotSimulator):
        check_slots(simulator, where)
    if episodic(simulator) is not None:
        _check_episodes(simulator, where)
        return
    _check_start(simulator, where)
    start = _begun(simulator, _latents(simulator), where)
    _check_tracks(simulator, start, where)
    if isinstance(simulator, SlotSimulator):
        check_kept(start, where)
        check_asked(simulator, start, where)
    course = _course(simulator, start, where)
    if isinstance(simulator, SlotSimulator):
        check_ever_present(simulator, course, where)
    else:
        _check_salient(simulator, course[1].signals, where)
    for states in (start, course[-1]):
        check_scene(simulator, states, where)
    _check_alike(simulator, course, where)
    _check_order(simulator, course, where)
    _check_continued(simulator, course, where)


def _outcomes(simulator: Simulator | SlotSimulator) -> BoolArray:
    """``[COUNT, T-1]``: what the rollouts are tried with."""
    steps = simulator.states - 1
    outcomes = np.zeros((COUNT, steps), dtype=np.bool_)
    outcomes[ALL_DETECTED] = True
    outcomes[MIXED] = np.random.default_rng(0).random(steps) < 0.5
    outcomes[MIXED_AGAIN] = outcomes[MIXED]
    return outcomes


def _latents(simulator: Simulator | SlotSimulator) -> StandardNormals:
    """Of the rollouts that it is tried with; no columns where it takes none."""
    return tried_normals(simulator, count=COUNT)


def _begun(
    simulator: Simulator | SlotSimulator, latents: StandardNormals, where: str
) -> StateBatch:
    count = len(latents.start)
    return _call(
        where, "initial", lambda: begun(simulator, count=count, start=latents.start.copy())
    )


def _check_start(simulator: Simulator | SlotSimulator, where: str) -> None:
    """With the same latents, or none, every rollout starts in the same state, every time."""
    latents = _latents(simulator).take(np.zeros(COUNT, dtype=np.int64))
    start = _begun(simulator, latents, where)
    _check_states(start, simulator, f"{where}: initial(count={COUNT})", step=0)
    for row in range(1, COUNT):
        other = _difference(simulator, _row(start, 0), _row(start, row))
        if other is not None:
            _refuse(
                f"{where}: initial gives rollouts that start differently ({other}); every "
                f"rollout must start in the same state; {DECLARE}"
            )
    again = _begun(simulator, latents, where)
    other = _difference(simulator, start, again)
    if other is not None:
        _refuse(f"{where}: initial gives another state when it is called again ({other})")


def _check_episodes(simulator: Simulator | SlotSimulator, where: str) -> None:
    """Two episodes with the same outcomes must be the same; nothing can be gone on from."""
    courses = [_episode(simulator, where) for _ in range(2)]
    for step, (one, other) in enumerate(zip(*courses, strict=True)):
        differs = _difference(simulator, one, other)
        if differs is not None:
            _refuse(
                f"{where}: an episode must be the same again after a reset with the same outcomes; "
                f"a second time it differs at step {step} ({differs})"
            )
    course = courses[0]
    _check_tracks(simulator, course[0], where)
    if isinstance(simulator, SlotSimulator):
        check_asked(simulator, course[0], where)
        check_ever_present(simulator, course, where)
    else:
        first = {name: np.repeat(values, COUNT) for name, values in course[1].signals.items()}
        _check_salient(simulator, first, where)
    check_scene(simulator, course[-1], where)


def _episode(simulator: Simulator | SlotSimulator, where: str) -> list[StateBatch]:
    """The states ``[1]`` of one episode with mixed outcomes."""
    mixed = slice(MIXED, MIXED + 1)
    outcomes, latents = _outcomes(simulator)[mixed], _latents(simulator).take(mixed)
    course = [_begun(simulator, latents, where)]
    for step in range(simulator.states - 1):
        _check_states(course[-1], simulator, f"{where}: reset or step", step=step, count=1)
        noise = latents.noise[:, step]
        course.append(_stepped(simulator, course[-1], outcomes[:, step], noise, where))
    _check_states(course[-1], simulator, f"{where}: step", step=simulator.states - 1, count=1)
    return [replace(one, memory=dict(kept_memory(one.memory))) for one in course]


def _check_tracks(simulator: Simulator | SlotSimulator, start: StateBatch, where: str) -> None:
    """A tracker that a simulator says it holds is its own, and lies in its states."""
    tracker, slots = tracker_of(simulator), getattr(simulator, "slots", None)
    if tracker is None:
        return
    if abs(tracker.dt_s - simulator.dt_s) > ROUNDING * simulator.dt_s:
        _refuse(f"{where}: dt_s = {simulator.dt_s:g}, and its tracker's is {tracker.dt_s:g}")
    tracks = tracker.start(COUNT, slots=None if slots is None else len(slots))
    absent = sorted(set(tracker.memory(tracks)) - set(start.memory))
    if absent:
        _refuse(
            f"{where}: the memory of its states lacks {', '.join(absent)}, which its tracker's "
            "memory gives"
        )


def _course(
    simulator: Simulator | SlotSimulator, start: StateBatch, where: str
) -> list[StateBatch]:
    """The states ``[COUNT]`` at every step; ``step`` leaves those that it is given alone."""
    outcomes, latents = _outcomes(simulator), _latents(simulator)
    course = [start]
    for step in range(simulator.states - 1):
        before = course[-1].map(np.array)
        noise = latents.noise[:, step]
        course.append(_stepped(simulator, course[-1], outcomes[:, step], noise, where))
        _check_states(course[-1], simulator, f"{where}: step", step=step + 1)
        if _difference(simulator, course[-2], before) is not None:
            _refuse(f"{where}: step writes to the states it is given; it must return new ones")
    return course


def _check_alike(
    simulator: Simulator | SlotSimulator, course: Sequence[StateBatch], where: str
) -> None:
    """Equal outcomes from equal states must lead to equal states."""
    for step, states in enumerate(course):
        other = _difference(simulator, _row(states, MIXED), _row(states, MIXED_AGAIN))
        if other is not None:
            _refuse(
                f"{where}: step must give the same again for the same outcomes; at step {step} "
                f"two such rollouts differ ({other}){COMPLETE}"
            )


def _check_order(
    simulator: Simulator | SlotSimulator, course: Sequence[StateBatch], where: str
) -> None:
    """A second time and in reverse order, every rollout must be what it was."""
    outcomes, latents = _outcomes(simulator)[::-1], _latents(simulator).take(slice(None, None, -1))
    states = _begun(simulator, latents, where)
    for step in range(simulator.states - 1):
        noise = latents.noise[:, step]
        states = _stepped(simulator, states, outcomes[:, step], noise, where)
        for row in range(COUNT):
            other = _difference(
                simulator, _row(course[step + 1], row), _row(states, COUNT - 1 - row)
            )
            if other is not None:
                _refuse(
                    f"{where}: step must give a rollout the same again, whatever is beside it "
                    f"and whatever ran before; a second time, in another order, it differs at "
                    f"step {step + 1} ({other})"
                )


def _check_continued(
    simulator: Simulator | SlotSimulator, course: Sequence[StateBatch], where: str
) -> None:
    """One rollout alone, from the start and from a state kept in the middle."""
    outcomes = _outcomes(simulator)[MIXED]
    latents = _latents(simulator).take(slice(MIXED, MIXED + 1))
    steps = simulator.states - 1
    middle = steps // 2
    alone = _row(_begun(simulator, latents, where), 0)
    legs = (
        ("alone", alone, range(middle)),
        (f"continued from its state at step {middle}", _row(course[middle], MIXED),
         range(middle, steps)),
    )  # fmt: skip
    for how, start, leg in legs:
        states = start
        for step in leg:
            noise = latents.noise[:, step]
            states = _stepped(simulator, states, outcomes[step : step + 1], noise, where)
            other = _difference(simulator, _row(course[step + 1], MIXED), states)
            if other is not None:
                _refuse(
                    f"{where}: a rollout must be the same again, whatever is beside it; {how}, "
                    f"it differs at step {step + 1} ({other}){COMPLETE}"
                )


def _stepped(
    simulator: Simulator | SlotSimulator,
    states: StateBatch,
    detected: BoolArray,
    noise: FloatArray,
    where: str,
) -> StateBatch:
    given = noise.copy()
    if isinstance(simulator, SlotSimulator):
        by_slot = _call(where, "present", lambda: outcomes_by_slot(simulator, states, detected))
        return _call(where, "step", lambda: stepped(simulator, states, by_slot, given))
    return _call(where, "step", lambda: stepped(simulator, states, detected.copy(), given))


def _difference(
    simulator: Simulator | SlotSimulator, one: StateBatch, other: StateBatch
) -> str | None:
    """The first thing in which states differ, in words; ``None`` if they agree.

    Signals and numbers in memory may differ by rounding. Objects, such as copies of an
    environment, need not know how to compare.
    """
    if not np.array_equal(one.step, other.step):
        return f"step {one.step} and {other.step}"
    if set(one.memory) != set(other.memory):
        return f"memory {sorted(one.memory)} and {sorted(other.memory)}"
    ranges = {signal.name: signal.high - signal.low for signal in simulator.signals}
    for name, values in {**one.signals, **one.memory}.items():
        others = other.signals[name] if name in ranges else other.memory[name]
        if values.dtype == np.object_:
            continue
        if values.dtype.kind == "f":
            scale = np.maximum(np.abs(values), ranges.get(name, 0.0))
            same = (np.abs(values - others) <= ROUNDING * scale) | (values == others)
        else:
            same = values == others
        if not np.all(same):
            row = int(np.argmin(same))
            return f"{name} {values[row]!s} and {others[row]!s}"
    return None


def _check_facts(simulator: Simulator | SlotSimulator, where: str) -> None:
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


def _check_states(
    states: StateBatch,
    simulator: Simulator | SlotSimulator,
    where: str,
    *,
    step: int,
    count: int = COUNT,
) -> None:
    if np.ndim(states.step) != 0 or int(states.step) != step:
        _refuse(f"{where}: step is {states.step!r}: must be one number for the batch, here {step}")
    declared = {signal.name for signal in simulator.signals}
    if set(states.signals) != declared:
        _refuse(f"{where}: signals are {sorted(states.signals)}, declared {sorted(declared)}")
    for name in states.memory:
        if name == VIOLATED or name.startswith(violated_rule("")):
            _refuse(f"{where}: the memory {name!r} is pemviz's own; choose another name")
    for name, values in {**states.signals, **states.memory}.items():
        if np.shape(values) != (count,):
            _refuse(f"{where}: {name} has shape {np.shape(values)}: must be ({count},)")
    for name, values in states.signals.items():
        if values.dtype != np.float64 or not np.isfinite(values).all():
            _refuse(f"{where}: {name} must be finite numbers of type float64 (state {step})")


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
    except ConfigError:  # said in words already
        raise
    except BaseException as error:  # the user's code may raise anything
        if isinstance(error, SimulationError) and error.__cause__ is None:
            raise ConfigError(str(error)) from error
        message = f"{where}: {what} raises {told(error)}"
        raise ConfigError(message) from error


def _row(states: StateBatch, row: int) -> StateBatch:
    return states.take(slice(row, row + 1))


def _refuse(message: str) -> NoReturn:
    raise ConfigError(message)
