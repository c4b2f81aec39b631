"""Exact failure probabilities, by a recursion that shares no code with any method.

Forward over the states that chains of outcomes reach, each with the state of an automaton that
reads the specification; states that differ by rounding alone are one. What an automaton says is
written by hand for each kind of specification, not derived from the parsed formula.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.pem.models.protocol import Pem
from pemviz.types import Simulator, StateBatch

VIOLATED, HELD = -1, -2
"""What an automaton's state is once the verdict stands; a pending one is 0 or more."""
QUANTUM = 1e-7
"""Below any difference between two states that matters [m, m/s]."""
MOST_STATES = 8_000_000

Signals = Mapping[str, FloatArray]
Condition = Callable[[Signals], BoolArray]
Automaton = Callable[[int, Signals, IntArray], IntArray]
"""Step, signals ``[N]`` at that step and states before ``[N]`` to the states after."""


def always(condition: Condition, first: int, last: int) -> Automaton:
    """``always[first,last] condition``."""

    def read(step: int, signals: Signals, state: IntArray) -> IntArray:
        if step < first:
            return state
        if step > last:
            return np.full_like(state, HELD)
        return np.where(condition(signals), state, VIOLATED)

    return read


def both(*rules: Automaton) -> Automaton:
    """All of several rules of ``always``, whose states are but pending or violated."""

    def read(step: int, signals: Signals, state: IntArray) -> IntArray:
        after = state
        for rule in rules:
            after = np.where(rule(step, signals, state) == VIOLATED, VIOLATED, after)
        return after

    return read


def until(before: Condition, goal: Condition, first: int, last: int) -> Automaton:
    """``before until[first,last] goal``, where ``before`` holds at the goal too."""

    def read(step: int, signals: Signals, state: IntArray) -> IntArray:
        after = state
        if step >= first:
            after = np.where(goal(signals), HELD, after)
        if step == last:
            after = np.where(after == HELD, HELD, VIOLATED)
        return np.where(before(signals), after, VIOLATED)

    return read


def eventually(goal: Condition, first: int, last: int) -> Automaton:
    """``eventually[first,last] goal``."""
    return until(_anything, goal, first, last)


def always_eventually(goal: Condition, first: int, last: int, width: int) -> Automaton:
    """``always[first,last] (eventually[0,width] goal)``; counts states without it in a row."""

    def read(step: int, signals: Signals, state: IntArray) -> IntArray:
        if step < first:
            return state
        without = np.where(goal(signals), 0, state + 1)
        return np.where((without > width) & (step - width <= last), VIOLATED, without)

    return read


def eventually_always(goal: Condition, first: int, last: int, width: int) -> Automaton:
    """``eventually[first,last] (always[0,width] goal)``; counts states with it in a row."""

    def read(step: int, signals: Signals, state: IntArray) -> IntArray:
        if step < first:
            return state
        row = np.minimum(np.where(goal(signals), state + 1, 0), width + 1)
        after = np.where((row > width) & (step - width <= last), HELD, row)
        return np.where((after >= 0) & (step == last + width), VIOLATED, after)

    return read


def response(trigger: Condition, goal: Condition, last: int, width: int) -> Automaton:
    """``always[0,last] (trigger -> eventually[0,width] goal)``; the age of the oldest trigger."""

    def read(step: int, signals: Signals, state: IntArray) -> IntArray:
        age = np.where(state > 0, state + 1, 0)
        if step <= last:
            age = np.where((age == 0) & trigger(signals), 1, age)
        age = np.where(goal(signals), 0, age)
        return np.where(age > width, VIOLATED, age)

    return read


def exact_probability(simulator: Simulator, pem: Pem, automaton: Automaton) -> float:
    """The probability that a rollout violates the specification that ``automaton`` reads.

    Raises:
        ValueError: The states do not merge, and become too many.
    """
    states = simulator.initial(count=1)
    mass, reading = np.ones(1), np.zeros(1, dtype=np.int64)
    reading = automaton(0, states.signals, reading)
    violated = float(mass[reading == VIOLATED].sum())
    for step in range(simulator.states - 1):
        pending = reading >= 0
        states, mass, reading = _rows(states, pending), mass[pending], reading[pending]
        if not mass.size:
            break
        missed = expit(-pem.logit(simulator.salient(states.signals)))
        branches = [
            (simulator.step(states, np.full(mass.size, detected)), mass * chance)
            for detected, chance in ((False, missed), (True, 1.0 - missed))
        ]
        after = [automaton(step + 1, branch.signals, reading) for branch, _ in branches]
        reading = np.concatenate(after)
        mass = np.concatenate([share for _, share in branches])
        states = _together([branch for branch, _ in branches], mass.size // 2)
        violated += float(mass[reading == VIOLATED].sum())
        states, mass, reading = _merged(states, mass, reading)
    return violated


def _anything(signals: Signals) -> BoolArray:
    return np.ones(next(iter(signals.values())).shape, dtype=np.bool_)


def _rows(states: StateBatch, chosen: Any) -> StateBatch:
    return replace(
        states,
        signals={name: values[chosen] for name, values in states.signals.items()},
        memory={name: values[chosen] for name, values in states.memory.items()},
    )


def _together(branches: list[StateBatch], count: int) -> StateBatch:
    def joined(parts: list[Mapping[str, Any]]) -> dict[str, AnyArray]:
        return {
            name: np.concatenate([np.broadcast_to(part[name], (count,)) for part in parts])
            for name in parts[0]
        }

    return replace(
        branches[0],
        signals=joined([dict(branch.signals) for branch in branches]),
        memory=joined([dict(branch.memory) for branch in branches]),
    )


def _merged(
    states: StateBatch, mass: FloatArray, reading: IntArray
) -> tuple[StateBatch, FloatArray, IntArray]:
    columns = [*states.signals.values(), *states.memory.values()]
    keys = np.zeros(mass.size, dtype=np.uint64)
    for column in (*(np.asarray(one, dtype=np.float64) / QUANTUM for one in columns), reading):
        keys = _hashed(keys ^ np.rint(column).astype(np.int64).view(np.uint64))
    _, firsts, groups = np.unique(keys, return_index=True, return_inverse=True)
    if firsts.size > MOST_STATES:
        message = f"{firsts.size} states at step {int(states.step)}: they do not merge"
        raise ValueError(message)
    together = np.bincount(groups, weights=mass).astype(np.float64)
    return _rows(states, firsts), together, reading[firsts]


def _hashed(keys: AnyArray) -> AnyArray:
    """Numbers of 64 bits mixed so that sums of such do not meet (splitmix64, Steele et al. 2014).

    Of the most states that are kept, two share a number with a probability of 5e-7.
    """
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return keys ^ (keys >> np.uint64(31))
