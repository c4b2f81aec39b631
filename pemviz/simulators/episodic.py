"""Simulators that can only be reset and stepped: an environment is one rollout at a time.

Nothing is saved. Several environments, each in a rollout of its own, make a simulator of so many
rollouts at once; a rollout costs one environment step for each of its steps. What goes on from
kept states (splitting, zero-variance, the reference) cannot have them.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count as counter
from typing import Any, Protocol, runtime_checkable
from uuid import uuid4

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.config.ranges import described
from pemviz.errors import ConfigError, RunError
from pemviz.faults import SimulationError, blame
from pemviz.latents import NO_LATENTS, LatentCounts
from pemviz.simulators.detector_loop import detecting
from pemviz.simulators.latents import within
from pemviz.simulators.slots import Slot
from pemviz.types import CERTAIN, Signal, SimulatorFacts, StateBatch

EPISODE = "episode_"
"""Memory: which episode a rollout is; not kept with rollouts."""


@runtime_checkable
class EpisodicSimulator(SimulatorFacts, Protocol):
    """An environment that is reset and stepped; no state of it is kept.

    With ``slots``, a method ``present`` and salient variables ``[..., K, D]`` as a
    :class:`pemviz.SlotSimulator` has them, ``step`` is given K outcomes. With ``latents`` as a
    :class:`pemviz.LatentCounts` ``reset`` is given the start's standard normals ``[S]``, if there
    are any, and ``step`` beside the outcome those of the step, ``[M]``.

    An environment in another process may have ``begin_reset`` and ``begin_step``, with the same
    arguments: they begin what the next ``reset`` or ``step`` returns, so that all work at once.
    """

    @property
    def reset(self) -> Callable[..., Mapping[str, float]]:
        """Begin an episode, always in the same state; the signals' values by name."""
        ...

    @property
    def step(self) -> Callable[..., tuple[Mapping[str, float], bool]]:
        """The signals after an outcome of perception, and whether the episode has ended.

        After that it is not stepped again: its signals stay until the rollout's last state.
        """
        ...


@dataclass
class Running:
    """The environments of this process, and the episodes that they are in."""

    environments: list[Any] = field(default_factory=list[Any])
    episodes: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    step: int = 0
    values: list[Mapping[str, float]] = field(default_factory=list[Mapping[str, float]])
    ended: list[bool] = field(default_factory=list[bool])


_IN_WORKER: dict[str, Running] = {}
_NUMBERS = counter()


@dataclass(frozen=True, kw_only=True, eq=False)
class SideBySide:
    """Environments side by side: a simulator of as many rollouts at a time.

    Attributes:
        make: Makes an environment; called for each place when it is first needed, in worker
            processes there.
        count: How many rollouts are carried out at a time, at least 1; the result does not
            depend on it.
        example: An environment, which tells what all have in common and takes the first place.
        key: By which a worker process knows its environments again.
        running: What this process's environments are at.
    """

    make: Callable[[], EpisodicSimulator]
    count: int = 1
    example: EpisodicSimulator = field(init=False, repr=False)
    key: str = field(init=False, repr=False, default_factory=lambda: uuid4().hex)
    running: Running = field(init=False, repr=False, default_factory=Running)

    def __post_init__(self) -> None:
        """Make the first environment.

        Raises:
            ConfigError: There is to be none, or what is made is no environment.
        """
        if self.count < 1:
            message = f"count = {self.count}: must be at least 1"
            raise ConfigError(message)
        first: Any = self.make()
        if isinstance(first, type) or not isinstance(first, EpisodicSimulator):
            message = f"make gives a {type(first).__name__}: must be a pemviz.EpisodicSimulator"
            raise ConfigError(message)
        object.__setattr__(self, "example", first)
        self.running.environments.append(first)

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: how environments are made, and none of them."""
        return {"make": self.make, "count": self.count, "key": self.key}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Environments of this process, which stay from one batch to the next."""
        running = _IN_WORKER.setdefault(state["key"], Running())
        if not running.environments:
            running.environments.append(state["make"]())
        own = {**state, "running": running, "example": running.environments[0]}
        for name, value in own.items():
            object.__setattr__(self, name, value)

    @property
    def name(self) -> str:
        """The environments' name."""
        return self.example.name

    @property
    def states(self) -> int:
        """States in a rollout."""
        return self.example.states

    @property
    def dt_s(self) -> float:
        """Time between two states [s]."""
        return self.example.dt_s

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The environments' signals."""
        return self.example.signals

    @property
    def latents(self) -> LatentCounts:
        """Standard normals that a rollout takes."""
        return getattr(self.example, "latents", NO_LATENTS)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """What perception depends on."""
        return self.example.salient(signals)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """Begin an episode in each of ``count`` environments, arrays ``[count]``.

        Of more episodes than :attr:`count` only the starts can be had.

        Raises:
            SimulationError: One of them raises something, or gives what does not fit.
        """
        running, places = self.running, min(count, self.count)
        while len(running.environments) < places:
            running.environments.append(self.make())
        given = [()] * count
        if start is not None and self.latents.at_start:
            given = [(z,) for z in start]
        running.values, running.ended, running.step = [], [False] * count, 0

        def begin(row: int) -> None:
            running.environments[row].begin_reset(*given[row])

        def reset(row: int) -> None:
            values = running.environments[row % places].reset(*given[row])
            running.values.append(self._checked(values))

        if count == places:
            self._each("reset", begin, filter(self._is_elsewhere, range(count)))
        self._each("reset", reset, range(count))
        running.episodes = np.array([next(_NUMBERS) for _ in range(count)], dtype=np.int64)
        return self._batch()

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The states one step on, for outcomes ``[N]`` or ``[N, K]``.

        Raises:
            RunError: These are not the states that the environments are in.
            SimulationError: One of them raises something, or gives what does not fit.
        """
        running = self.running
        here = np.array_equal(states.memory[EPISODE], running.episodes)
        if not here or int(states.step) != running.step or len(detected) > self.count:
            message = f"simulator {self.name!r}: is episodic: its states cannot be gone on from"
            raise RunError(message)
        given = [
            (outcome,) if noise is None or not self.latents.noise else (outcome, noise[row])
            for row, outcome in enumerate(detected.tolist())
        ]
        going = [row for row, ended in enumerate(running.ended) if not ended]

        def begin(row: int) -> None:
            running.environments[row].begin_step(*given[row])

        def step(row: int) -> None:
            answer = running.environments[row].step(*given[row])
            if not (isinstance(answer, tuple) and len(answer) == 2):
                what = f"simulator {self.name!r}: step gives {described(answer)}"
                why = "must be two things, signals by name and whether the episode has ended"
                raise SimulationError(what, why=why)
            running.values[row], running.ended[row] = self._checked(answer[0]), bool(answer[1])

        self._each("step", begin, filter(self._is_elsewhere, going))
        self._each("step", step, going)
        running.step += 1
        return self._batch()

    def _is_elsewhere(self, row: int) -> bool:
        """Whether it is an environment of another process, which can begin and be waited for."""
        environment = self.running.environments[row]
        return hasattr(environment, "begin_reset") and hasattr(environment, "begin_step")

    def _each(self, what: str, call: Callable[[int], None], rows: Iterable[int]) -> None:
        """One environment after the other; what one raises names its rollout."""
        row = 0
        try:
            for row in rows:
                call(row)
        except BaseException as error:  # an environment may raise anything
            rollouts = range(row, row + 1)
            what = f"simulator {self.name}: {what}"
            blame(error, what, step=self.running.step, rollouts=rollouts, breaks=True)

    def _checked(self, values: Any) -> Mapping[str, float]:
        declared = {signal.name for signal in self.signals}
        if not isinstance(values, Mapping):
            what = f"simulator {self.name!r}: reset or step gives {described(values)}"
            raise SimulationError(what, why="must be the signals' values by name")
        if set(values) != declared:
            what = (
                f"simulator {self.name!r}: reset or step gives {sorted(values)}, signals declare "
                f"{sorted(declared)}"
            )
            raise SimulationError(what, why="must be the same names")
        for name, value in values.items():
            if np.ndim(value):
                what = f"simulator {self.name!r}: {name} is an array of shape {np.shape(value)}"
                raise SimulationError(what, why="must be one number")
        return values

    def _batch(self) -> StateBatch:
        running = self.running
        signals = {
            signal.name: np.array([v[signal.name] for v in running.values], dtype=np.float64)
            for signal in self.signals
        }
        step = np.array(running.step, dtype=np.int64)
        memory: dict[str, AnyArray] = {EPISODE: running.episodes.copy()}
        if detecting(self.example) is not None:
            memory[CERTAIN] = np.ones(len(running.values), dtype=np.bool_)
        return StateBatch(step=step, signals=signals, memory=memory)


@dataclass(frozen=True, kw_only=True, eq=False)
class SideBySideSlots(SideBySide):
    """The same for environments with slots: a :class:`pemviz.SlotSimulator`."""

    @property
    def slots(self) -> tuple[Slot, ...]:
        """The environments' slots."""
        return self._with_slots.slots

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where perception has something to answer, ``[..., K]``."""
        return self._with_slots.present(signals)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where what is reported may matter, ``[..., K]``; everywhere if nothing is said."""
        if hasattr(self.example, "reacts"):
            return self._with_slots.reacts(signals)
        shape = next(iter(signals.values())).shape
        return np.ones((*shape, len(self.slots)), dtype=np.bool_)

    @property
    def _with_slots(self) -> Any:
        return self.example


def side_by_side(
    environments: EpisodicSimulator | Sequence[EpisodicSimulator] | Callable[[], Any],
    count: int = 1,
) -> SideBySide:
    """Environments as a simulator of several rollouts at a time.

    Args:
        environments: One, or several of a kind; or what makes one, a function that can be pickled
            if worker processes are to have theirs.
        count: Of environments made: how many.

    Raises:
        ConfigError: There is none, or it is none.
    """
    if isinstance(environments, EpisodicSimulator) and not isinstance(environments, type):
        environments = [environments]
    if isinstance(environments, Sequence):
        if not environments:
            message = "environments: must be one at least"
            raise ConfigError(message)
        make, count = _Given(list(environments)), len(environments)
    else:
        make = environments
    found = SideBySide(make=make, count=count)
    if hasattr(found.example, "slots"):
        return SideBySideSlots(make=_Given([found.example], make), count=count)
    return found


@dataclass
class _Given:
    """Hands out environments one after the other, then those that are made."""

    environments: list[EpisodicSimulator]
    make: Callable[[], EpisodicSimulator] | None = None
    taken: int = 0

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process begins with the first."""
        return _Given, (self.environments, self.make)

    def __call__(self) -> EpisodicSimulator:
        self.taken += 1
        if self.taken <= len(self.environments):
            return self.environments[self.taken - 1]
        if self.make is None:
            message = f"more than the {len(self.environments)} environments given are needed"
            raise ConfigError(message)
        return self.make()


def kept_memory(memory: Mapping[str, AnyArray]) -> Mapping[str, AnyArray]:
    """What of a state's memory says something of the rollout: all but which episode it is."""
    return {name: values for name, values in memory.items() if name != EPISODE}


def episodic(simulator: object) -> SideBySide | None:
    """The environments within a simulator, whatever wraps it; ``None``: there are none."""
    return within(simulator, SideBySide)
