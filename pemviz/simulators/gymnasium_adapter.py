"""A gymnasium environment that is told, at each step, what perception detected.

gymnasium itself is not imported here: whatever has ``reset`` and ``step`` will do.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.simulators.kept_steps import KeptSteps
from pemviz.simulators.slots import Slot
from pemviz.types import Signal, StateBatch

ENDED = "ended"
SNAPSHOT = "snapshot"
NUMBER = "environment_"
KEPT_STEPS = 100_000


class Environment(Protocol):
    """What is used of ``gymnasium.Env``."""

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """The first observation, and information that is not looked at."""
        ...

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Observation, reward, terminated, truncated and information."""
        ...


def detection_action(detected: bool) -> int:
    """The action of an environment whose action space is ``Discrete(2)``: 1 if detected."""
    return int(detected)


def detections_action(detected: Sequence[bool]) -> AnyArray:
    """The action of an environment whose action space is ``MultiBinary(K)``: 1 where detected."""
    return np.array(detected, dtype=np.int8)


def signal_values(signals: Mapping[str, FloatArray]) -> FloatArray:
    """All signals ``[...]`` in their order as salient variables ``[..., D]``."""
    return np.stack(list(signals.values()), axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumSimulator:
    """Each rollout of a batch in turn is put into one environment, stepped, read back.

    The environment must do the same again from the same state; its own randomness, if it has
    any, is that of ``seed``, so that the answer is for this one course of it. Once an episode
    has ended, its signals stay as they are until the last step.

    Attributes:
        environment: The environment; used by one thread at a time.
        signals: What specifications may name.
        observe: An observation to the signals' values by name.
        states: States in a rollout (T).
        dt_s: Time between two states [s].
        salient_of: Signals ``[...]`` to what the detector's answer depends on ``[..., D]``.
        action_of: Perception's outcome to the environment's action.
        get_state: All that decides how the environment goes on, as numbers ``[S]``. With
            ``set_state`` it is quick and small; without the pair, a deep copy of the
            environment is kept for every state of every rollout.
        set_state: Puts the environment into a state that ``get_state`` gave.
        seed: The environment is reset with.
        name: For files and tables.
        kept_steps: With the pair, so many steps are remembered and not made again, which methods
            that go on from kept states ask for many times over; about 1 kB each.
    """

    environment: Environment
    signals: tuple[Signal, ...]
    observe: Callable[[Any], Mapping[str, float]]
    states: int
    dt_s: float
    salient_of: Callable[[Mapping[str, FloatArray]], FloatArray] = signal_values
    action_of: Callable[[Any], Any] = detection_action
    get_state: Callable[[Any], FloatArray] | None = None
    set_state: Callable[[Any, FloatArray], None] | None = None
    seed: int = 0
    name: str = "gymnasium"
    kept_steps: int = KEPT_STEPS
    _steps: KeptSteps = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Refuse half of the pair that keeps states as numbers.

        Raises:
            ConfigError: ``get_state`` without ``set_state``, or the other way round.
        """
        object.__setattr__(self, "_steps", KeptSteps(self.kept_steps))
        if (self.get_state is None) != (self.set_state is None):
            given, missing = "get_state", "set_state"
            if self.get_state is None:
                given, missing = missing, given
            message = (
                f"simulator {self.name!r}: has {given} but no {missing}: give both, or neither "
                "to keep copies of the environment"
            )
            raise ConfigError(message)

    def initial(self, *, count: int) -> StateBatch:
        """``count`` copies of the state after a reset, arrays ``[count]``."""
        observation, _ = self.environment.reset(seed=self.seed)
        row = (self._observed(observation), self._snapshot(self.environment), False)
        return self._batch([row] * count, step=np.zeros((), dtype=np.int64))

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """The states one step on, for outcomes ``[N]``."""
        stored = self._stored(states)
        rows = [
            self._advanced(states, row, stored[row], seen)
            for row, seen in enumerate(detected.tolist())
        ]
        return self._batch(rows, step=states.step + 1)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """What the detector's answer depends on, ``[..., D]``."""
        return self.salient_of({signal.name: signals[signal.name] for signal in self.signals})

    @property
    def _has_pair(self) -> bool:
        return self.get_state is not None and self.set_state is not None

    def _advanced(self, states: StateBatch, row: int, stored: Any, detected: Any) -> "_Row":
        if states.memory[ENDED][row]:
            values = {name: float(array[row]) for name, array in states.signals.items()}
            return values, stored, True
        if not self._has_pair:
            return self._stepped(stored, detected)
        names = [signal.name for signal in self.signals]

        def make() -> FloatArray:
            values, numbers, ended = self._stepped(stored, detected)
            return np.concatenate(([values[name] for name in names], numbers, [ended]))

        *values, ended = (reached := self._steps.reached(stored, detected, make)).tolist()
        return dict(zip(names, values, strict=False)), reached[len(names) : -1], bool(ended)

    def _stepped(self, stored: Any, detected: Any) -> "_Row":
        environment = self._restored(stored)
        observation, _, terminated, truncated, _ = environment.step(self.action_of(detected))
        ended = bool(terminated or truncated)
        reached = (self._observed(observation), self._snapshot(environment), ended)
        if ended:  # before it serves another rollout
            environment.reset(seed=self.seed)
        return reached

    def _observed(self, observation: Any) -> Mapping[str, float]:
        values = self.observe(observation)
        declared = {signal.name for signal in self.signals}
        if set(values) != declared:
            message = (
                f"simulator {self.name!r}: observe gives {sorted(values)}, signals declare "
                f"{sorted(declared)}: must be the same names"
            )
            raise ConfigError(message)
        return values

    def _snapshot(self, environment: Environment) -> Any:
        """What a state keeps of the environment: numbers ``[S]``, or the environment itself."""
        if self.get_state is None or self.set_state is None:
            return copy.deepcopy(environment)
        return np.array(self.get_state(environment), dtype=np.float64)

    def _stored(self, states: StateBatch) -> AnyArray:
        """What is kept of each state's environment: numbers ``[N, S]``, or ``[N]`` copies."""
        if not self._has_pair:
            return states.memory[SNAPSHOT]
        numbers = [values for name, values in states.memory.items() if name.startswith(NUMBER)]
        return np.stack(numbers, axis=-1)

    def _restored(self, stored: Any) -> Environment:
        """An environment that may be stepped: the states given are never touched."""
        if self.set_state is None or self.get_state is None:
            return copy.deepcopy(stored)
        self.set_state(self.environment, stored)
        return self.environment

    def _batch(self, rows: "list[_Row]", *, step: AnyArray) -> StateBatch:
        observed = [values for values, _, _ in rows]
        signals = {
            signal.name: np.array([values[signal.name] for values in observed], dtype=np.float64)
            for signal in self.signals
        }
        ended = np.array([over for _, _, over in rows], dtype=np.bool_)
        snapshots = [snapshot for _, snapshot, _ in rows]
        return StateBatch(
            step=step, signals=signals, memory={ENDED: ended, **self._remembered(snapshots)}
        )

    def _remembered(self, kept: list[Any]) -> dict[str, AnyArray]:
        if self._has_pair:
            table = np.array(kept, dtype=np.float64).reshape(len(kept), -1)
            return {f"{NUMBER}{column}": table[:, column] for column in range(table.shape[1])}
        copies = np.empty(len(kept), dtype=np.object_)
        for row, snapshot in enumerate(kept):
            copies[row] = snapshot
        return {SNAPSHOT: copies}


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumSlotSimulator(GymnasiumSimulator):
    """The same for K obstacles or ghosts a step: a :class:`pemviz.SlotSimulator`.

    Attributes:
        slots: The K slots.
        present_of: Signals ``[...]`` to where perception has something to answer, ``[..., K]``;
            ``None``: everywhere.
        reacts_of: Signals ``[...]`` to where the environment reacts to what is detected,
            ``[..., K]``; ``None``: it may everywhere.
        salient_of: Signals ``[...]`` to each slot's salient variables, ``[..., K, D]``; if it is
            left out, these are its own signals.
        action_of: Perception's outcomes, K of them, to the environment's action.
    """

    slots: tuple[Slot, ...]
    present_of: Callable[[Mapping[str, FloatArray]], BoolArray] | None = None
    reacts_of: Callable[[Mapping[str, FloatArray]], BoolArray] | None = None
    action_of: Callable[[Any], Any] = detections_action

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Each slot's salient variables, ``[..., K, D]``."""
        if self.salient_of is not signal_values:
            return self.salient_of(signals)
        by_slot = [[signals[name] for name in slot.signals] for slot in self.slots]
        return np.stack([np.stack(own, axis=-1) for own in by_slot], axis=-2)

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where perception has something to answer, ``[..., K]``."""
        return of_slots(self.present_of, signals, slots=self.slots)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where what is detected may matter, ``[..., K]``."""
        return of_slots(self.reacts_of, signals, slots=self.slots)


def of_slots(
    function: Callable[[Mapping[str, FloatArray]], BoolArray] | None,
    signals: Mapping[str, FloatArray],
    *,
    slots: Sequence[Slot],
) -> BoolArray:
    """What a function says of signals ``[...]`` and each slot, ``[..., K]``; without one, yes."""
    if function is not None:
        return function(signals)
    shape = next(iter(signals.values())).shape
    return np.ones((*shape, len(slots)), dtype=np.bool_)


_Row = tuple[Mapping[str, float], Any, bool]
