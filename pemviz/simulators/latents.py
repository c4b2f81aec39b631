"""Scenarios with latents, those without, and what wraps them: begun, stepped and asked alike."""

from collections.abc import Mapping
from typing import Any, NoReturn, Protocol, TypeVar, runtime_checkable

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.faults import SimulationError, blame
from pemviz.latents import NO_LATENTS, LatentCounts
from pemviz.types import Signal, Simulator, StateBatch

Part = TypeVar("Part")


@runtime_checkable
class LatentSimulator(Protocol):
    """A scenario that takes standard normals at the start, at every step, or both.

    Like :class:`pemviz.types.Simulator`, or like one with slots, but for what its counts add:
    with ``start`` S above 0 ``initial(count, start)`` is given standard normals ``[N, S]``, those
    of ``seeds`` after them, and with ``noise`` M above 0 ``step(states, detected, noise)`` is given
    those of the step, ``[N, M]``. Both stay pure: all that is random about a rollout is in them and
    in the outcomes.
    """

    @property
    def latents(self) -> LatentCounts:
        """How many."""
        ...

    @property
    def name(self) -> str:
        """Back end's name for files and tables."""
        ...

    @property
    def states(self) -> int:
        """States in a rollout (T)."""
        ...

    @property
    def dt_s(self) -> float:
        """Time between two states [s]."""
        ...

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The signals that a state carries."""
        ...

    def initial(self, *args: Any, **kwargs: Any) -> StateBatch:
        """``initial(*, count)`` or ``initial(*, count, start)``."""
        ...

    def step(self, *args: Any, **kwargs: Any) -> StateBatch:
        """``step(states, detected)`` or ``step(states, detected, noise)``."""
        ...

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Signals ``[...]`` to what perception depends on: salient variables ``[..., D]``."""
        ...


def within(simulator: object, kind: type[Part]) -> Part | None:
    """The part of a kind, at or beneath what wraps it as its ``scenario``; ``None``: there is none.

    Args:
        simulator: Any.
        kind: A class, or a protocol that can be checked.
    """
    part: object = simulator
    while part is not None and not isinstance(part, kind):
        part = getattr(part, "scenario", None)
    return part


def latent_counts(simulator: object) -> LatentCounts:
    """How many latents a simulator takes; none where it does not say."""
    return getattr(simulator, "latents", NO_LATENTS)


def begun(
    simulator: Simulator | LatentSimulator, *, count: int, start: FloatArray | None = None
) -> StateBatch:
    """The states in which ``count`` rollouts start.

    Args:
        simulator: The scenario, with or without latents.
        count: Number of rollouts N.
        start: Its latents, ``[N, S]``; ``None``: all 0, the median.

    Raises:
        SimulationError: The scenario raises something.
    """
    latents = latent_counts(simulator).at_start
    try:
        if latents == 0:
            return _states(simulator, simulator.initial(count=count))
        given = np.zeros((count, latents)) if start is None else start
        return _states(simulator, cast_latent(simulator).initial(count=count, start=given))
    except BaseException as error:  # theirs may raise anything
        blame(error, f"simulator {simulator.name}: initial", step=0, rollouts=range(count))


def stepped(
    simulator: Simulator | LatentSimulator,
    states: StateBatch,
    detected: BoolArray,
    noise: FloatArray | None = None,
) -> StateBatch:
    """The next states after outcomes ``[N]``.

    Args:
        simulator: The scenario, with or without latents.
        states: ``[N]``.
        detected: ``[N]``, or as the scenario has its outcomes.
        noise: Latents of the step, ``[N, M]``; ``None``: all 0.

    Raises:
        SimulationError: The scenario raises something.
    """
    latents = latent_counts(simulator).noise
    try:
        if latents == 0:
            return _states(simulator, simulator.step(states, detected))
        given = np.zeros((len(detected), latents)) if noise is None else noise
        return _states(simulator, cast_latent(simulator).step(states, detected, given))
    except BaseException as error:  # as above
        _blame_at(error, simulator, "step", states)


def salient_of(simulator: Simulator, states: StateBatch) -> FloatArray:
    """What perception depends on at a simulator's own states: salient variables ``[N, D]``.

    Asked are the signals, or the simulator's ``salient_at(states)`` if it has one: where states
    already know what their signals would tell.

    Raises:
        SimulationError: The simulator raises something.
    """
    at_states = getattr(simulator, "salient_at", None)
    try:
        return simulator.salient(states.signals) if at_states is None else at_states(states)
    except BaseException as error:  # as above
        _blame_at(error, simulator, "salient", states)


def _states(simulator: Any, given: Any) -> StateBatch:
    if isinstance(given, StateBatch):
        return given
    what = f"simulator {simulator.name} gives a {type(given).__name__}"
    raise SimulationError(what, why="must be a pemviz.StateBatch")


def _blame_at(error: BaseException, simulator: Any, asked: str, states: StateBatch) -> NoReturn:
    """Tell of what a scenario raised at ``states``, which count its turns where it takes turns."""
    turns, part = 1, simulator
    while (inner := getattr(part, "scenario", None)) is not None:
        turns, part = getattr(part, "turns", turns), inner
    step = int(states.step) // turns if np.ndim(states.step) == 0 else None
    blame(
        error,
        f"simulator {simulator.name}: {asked}",
        step=step,
        rollouts=range(len(next(iter(states.signals.values())))),
    )


def cast_latent(simulator: Any) -> LatentSimulator:
    """A simulator that is known to declare latents."""
    return simulator
