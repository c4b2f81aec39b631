"""Gymnasium environments that are given, at each step, what perception detected.

gymnasium itself is not imported here: whatever has ``reset`` and ``step`` will do.
"""

import copy
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.latents import NO_LATENTS, SEED_LATENTS, LatentCounts
from pemviz.quantiles import seed_of
from pemviz.simulators.own_randomness import seed_of_reset
from pemviz.simulators.slots import Slot
from pemviz.types import Signal, StateBatch

ENDED = "ended"
SNAPSHOT = "snapshot"
NUMBER = "environment_"
KEPT_STEPS = 100_000
TRIED = 500
"""So many steps that are known are made again all the same: an environment that does not do the
same from the same numbers is to be seen as it is, by the check of simulators and by runs."""


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


def named_detections_action(
    slots: Sequence[Slot],
) -> Callable[[Sequence[bool]], dict[str, int]]:
    """Perception's outcomes to the action of an environment whose action space is a ``Dict``.

    Args:
        slots: Their names are the dict's keys, each a ``Discrete(2)``: 1 where detected.
    """
    names = [slot.name for slot in slots]
    return lambda detected: dict(zip(names, map(int, detected), strict=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumAdapter:
    """One environment, and how perception and specifications see it.

    Attributes:
        environment: The environment; used by one thread at a time.
        signals: What specifications may name.
        observe: An observation to the signals' values by name.
        states: States in a rollout (T).
        dt_s: Time between two states [s].
        salient_of: Signals ``[...]`` to what the detector's answer depends on ``[..., D]``.
        action_of: Perception's outcome to the environment's action.
        seed: The environment is reset with; ``None``: each rollout with one of its own, drawn
            like what else is random about it and moved by no proposal.
        fixed_randomness: Whether it is meant that the environment's own randomness, if it has any,
            is that of ``seed`` in every rollout.
        name: For files and tables.
    """

    environment: Environment
    signals: tuple[Signal, ...]
    observe: Callable[[Any], Mapping[str, float]]
    states: int
    dt_s: float
    salient_of: Callable[[Mapping[str, FloatArray]], FloatArray] = signal_values
    action_of: Callable[[Any], Any] = detection_action
    seed: int | None = 0
    fixed_randomness: bool = False
    name: str = "gymnasium"

    @property
    def latents(self) -> LatentCounts:
        """One for the seed where each rollout has its own."""
        return SEED_LATENTS if self.seed is None else NO_LATENTS

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """What the detector's answer depends on, ``[..., D]``."""
        return self.salient_of({signal.name: signals[signal.name] for signal in self.signals})

    @property
    def films(self) -> bool:
        """Whether the environment draws itself: its ``render_mode`` is ``rgb_array``."""
        return getattr(self.environment, "render_mode", None) == "rgb_array"

    def pictures(
        self, outcomes: BoolArray, *, start: FloatArray | None = None
    ) -> Iterator[AnyArray]:
        """What the environment renders after a reset and after each of perception's outcomes."""
        environment: Any = self.environment
        self._reset(() if start is None else start)
        yield environment.render()
        for outcome in outcomes.tolist():
            _, _, terminated, truncated, _ = environment.step(self.action_of(outcome))
            yield environment.render()
            if terminated or truncated:
                return

    def _reset(self, normals: FloatArray | Sequence[float] = ()) -> Any:
        """The first observation, with the seed that the latents ``[1]`` give if there are any."""
        seed = seed_of(normals[0]) if self.seed is None else self.seed
        return self.environment.reset(seed=seed_of_reset(seed))[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumSlots(GymnasiumAdapter):
    """The same for K obstacles or ghosts a step, with a vector or a dict of outcomes as action.

    Attributes:
        slots: The K slots.
        present_of: Signals ``[...]`` to where perception has something to answer, ``[..., K]``;
            ``None``: everywhere.
        reacts_of: Signals ``[...]`` to where the environment reacts to what is detected,
            ``[..., K]``; ``None``: it may everywhere.
        salient_of: Signals ``[...]`` to each slot's salient variables, ``[..., K, D]``; if it is
            left out, these are its own signals.
        action_of: Perception's outcomes, K of them, to the environment's action; see
            :func:`named_detections_action` for a dict.
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
        return self._by_slot(self.present_of, signals)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where what is detected may matter, ``[..., K]``."""
        return self._by_slot(self.reacts_of, signals)

    def _by_slot(
        self,
        function: Callable[[Mapping[str, FloatArray]], BoolArray] | None,
        signals: Mapping[str, FloatArray],
    ) -> BoolArray:
        if function is not None:
            return function(signals)
        shape = next(iter(signals.values())).shape
        return np.ones((*shape, len(self.slots)), dtype=np.bool_)


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumSimulator(GymnasiumAdapter):
    """Each rollout of a batch in turn is put into one environment, stepped, read back.

    The environment must do the same again from the same state: what it draws in its steps must
    be kept with it, as copies do. Once an episode has ended, its signals stay as they are until
    the last step.

    Attributes:
        get_state: All that decides how the environment goes on, as numbers ``[S]``. With
            ``set_state`` it is quick and small; without the pair, a deep copy of the
            environment is kept for every state of every rollout.
        set_state: Puts the environment into a state that ``get_state`` gave.
        kept_steps: With the pair, so many steps are remembered and not made again, which methods
            that go on from kept states take many times over; about 1 kB each.
    """

    get_state: Callable[[Any], FloatArray] | None = None
    set_state: Callable[[Any, FloatArray], None] | None = None
    kept_steps: int = KEPT_STEPS
    _steps: "KeptSteps" = field(init=False, repr=False)

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

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The state after a reset, ``count`` times: with one seed, or by ``start [count, 1]``."""
        resets: list[_Row] = []
        for normals in [()] if start is None else start:
            observed = self._observed(self._reset(normals))
            resets.append((observed, self._snapshot(self.environment), False))
        rows = resets * count if start is None else resets
        return self._batch(rows, step=np.zeros((), dtype=np.int64))

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """The states one step on, for outcomes ``[N]``."""
        stored = self._stored(states)
        rows = [
            self._advanced(states, row, stored[row], seen)
            for row, seen in enumerate(detected.tolist())
        ]
        return self._batch(rows, step=states.step + 1)

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
        signals = {
            signal.name: np.array([values[signal.name] for values, _, _ in rows], dtype=np.float64)
            for signal in self.signals
        }
        ended = np.array([over for _, _, over in rows], dtype=np.bool_)
        remembered = self._remembered([snapshot for _, snapshot, _ in rows])
        return StateBatch(step=step, signals=signals, memory={ENDED: ended, **remembered})

    def _remembered(self, kept: list[Any]) -> dict[str, AnyArray]:
        if self._has_pair:
            table = np.array(kept, dtype=np.float64).reshape(len(kept), -1)
            return {f"{NUMBER}{column}": table[:, column] for column in range(table.shape[1])}
        copies = np.empty(len(kept), dtype=np.object_)
        for row, snapshot in enumerate(kept):
            copies[row] = snapshot
        return {SNAPSHOT: copies}


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumSlotSimulator(GymnasiumSlots, GymnasiumSimulator):
    """The same for K obstacles or ghosts a step: a :class:`pemviz.SlotSimulator`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumEpisodes(GymnasiumAdapter):
    """One environment as a :class:`pemviz.EpisodicSimulator`: a step of it for each step.

    It needs no ``get_state`` and is never copied, but must begin in the same state after each
    reset with the same seed, and do the same again for the same actions.
    """

    def reset(self, *normals: FloatArray) -> Mapping[str, float]:
        """The signals after a reset, with the seed that latents ``[1]`` give if there are any."""
        return self.observe(self._reset(*normals))

    def step(self, outcome: Any) -> tuple[Mapping[str, float], bool]:
        """The signals after an outcome, and whether the episode is terminated or truncated."""
        answer = self.environment.step(self.action_of(outcome))
        return self.observe(answer[0]), bool(answer[2] or answer[3])

    def render(self) -> AnyArray:
        """What the environment renders of its present state."""
        environment: Any = self.environment
        return environment.render()


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumSlotEpisodes(GymnasiumSlots, GymnasiumEpisodes):
    """The same for K obstacles or ghosts a step."""


class KeptSteps:
    """Where outcomes led from states given as numbers; beyond ``most``, the oldest are forgotten.

    Methods that go on from kept states need the same step again and again: splitting's importance
    function carries every state on to the end with the same few sequences of outcomes. An
    environment that is once found to lead elsewhere has its steps made anew from then on.
    What is sent to another process arrives empty.
    """

    def __init__(self, most: int) -> None:
        """Prepare for so many steps; 0 keeps none."""
        self._most = most
        self._tried = 0
        self._found: OrderedDict[bytes, FloatArray] = OrderedDict()

    def reached(
        self, state: FloatArray, outcome: Any, make: Callable[[], FloatArray]
    ) -> FloatArray:
        """Where a step leads from numbers ``[S]``, as numbers ``[R]``; ``make`` makes it.

        Another last bit is another state.
        """
        if self._most == 0:
            return make()
        digest = hashlib.blake2b(state.tobytes(), digest_size=16)
        digest.update(repr(outcome).encode())
        key = digest.digest()
        known = self._found.get(key)
        if known is not None and self._tried >= TRIED:
            self._found.move_to_end(key)
            return known
        fresh = make()
        if known is not None:
            self._tried += 1
            if not np.array_equal(known, fresh):
                self._most = 0
                self._found.clear()
                return fresh
        self._found[key] = fresh
        if len(self._found) > self._most:
            self._found.popitem(last=False)
        return fresh

    def __getstate__(self) -> dict[str, Any]:
        """Without what was found."""
        return {"_most": self._most, "_tried": 0, "_found": OrderedDict()}


_Row = tuple[Mapping[str, float], Any, bool]
