"""A back end whose states also say what perception's last outcome was."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.simulators.latched import WrappedSimulator
from pemviz.simulators.latents import begun, salient_of, stepped
from pemviz.simulators.slots import UnrolledSimulator
from pemviz.types import CERTAIN, Signal, Simulator, StateBatch

LAST_OUTCOME = Signal(name="last_outcome", key="last_outcome", unit="", low=-1.0, high=1.0)
"""Missed (-1), detected (1), or none yet (0)."""
LAST = "last_outcome_"
"""Memory, with a slot's number: its last outcome."""


@dataclass(frozen=True)
class RememberingSimulator(WrappedSimulator):
    """The same scenario with :data:`LAST_OUTCOME` as one more signal and salient variable.

    Whatever perception remembers of its last outcome then is a function of the state, and a
    simulator of rollouts with memory is one of rollouts without.
    """

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The back end's signals, and the last outcome."""
        return (*self.scenario.signals, LAST_OUTCOME)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The back end's initial states, before any outcome."""
        return _after(begun(self.scenario, count=count, start=start), np.zeros(count))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The back end's next states after outcomes ``[N]``."""
        own = {name: v for name, v in states.signals.items() if name != LAST_OUTCOME.name}
        last = np.where(detected, _ones(states), -_ones(states))
        return _after(stepped(self.scenario, replace(states, signals=own), detected, noise), last)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The back end's salient variables and the last outcome, ``[..., D + 1]``."""
        own = self.scenario.salient({n: v for n, v in signals.items() if n != LAST_OUTCOME.name})
        last = signals[LAST_OUTCOME.name]
        return np.concatenate((own, last[..., None]), -1)

    def salient_at(self, states: StateBatch) -> FloatArray:
        """The same at states."""
        own, last = salient_of(self.scenario, states), states.signals[LAST_OUTCOME.name]
        return np.concatenate((own, last[..., None]), -1)


@dataclass(frozen=True)
class RememberingSlots(RememberingSimulator):
    """The same for a scenario with slots: the signal shows the last outcome of the slot in turn.

    A slot that was absent has none: what comes into view again begins anew.
    """

    scenario: UnrolledSimulator

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The unrolled initial states, before any outcome."""
        states = begun(self.scenario, count=count, start=start)
        none = {f"{LAST}{slot}": np.zeros(count) for slot in range(self.scenario.turns)}
        return _after(replace(states, memory={**states.memory, **none}), np.zeros(count))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The unrolled next states after outcomes ``[N]``."""
        turn = int(states.step) % self.scenario.turns
        kept = {n: v for n, v in states.memory.items() if n.startswith(LAST)}
        own = {n: v for n, v in states.memory.items() if n not in kept}
        after = stepped(self.scenario, replace(states, memory=own), detected, noise)
        outcome = np.where(detected, 1.0, -1.0)
        kept[f"{LAST}{turn}"] = np.where(states.memory[CERTAIN], 0.0, outcome)
        following = kept[f"{LAST}{(turn + 1) % self.scenario.turns}"]
        shown = np.where(after.memory[CERTAIN], 0.0, following)
        return _after(replace(after, memory={**after.memory, **kept}), shown)


def remembering(simulator: Simulator) -> RememberingSimulator:
    """A back end that carries the last outcome.

    Raises:
        ConfigError: It has a signal of that name of its own.
    """
    if any(LAST_OUTCOME.name in (signal.name, signal.key) for signal in simulator.signals):
        message = (
            f"simulator {simulator.name!r}: the signal {LAST_OUTCOME.name!r} is pemviz's own "
            "where memory_s is above 0; choose another name"
        )
        raise ConfigError(message)
    if isinstance(simulator, UnrolledSimulator):
        return RememberingSlots(simulator)
    return RememberingSimulator(simulator)


def _after(states: StateBatch, last: FloatArray) -> StateBatch:
    return replace(states, signals={**states.signals, LAST_OUTCOME.name: last})


def _ones(states: StateBatch) -> Any:
    last = states.signals[LAST_OUTCOME.name]
    return np.ones_like(last)
