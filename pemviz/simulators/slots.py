"""Several obstacles or ghosts a step: slots, which take turns within the step.

Perception answers for every slot of a step. An unrolled step is one slot's turn: the error model
is evaluated for that slot, its outcome is kept in the state's memory, and with the last slot's turn
the scenario moves. A scenario with K slots thereby is one with a single outcome a step, and what is
a function of the state, such as what the slots before it brought in the same step, methods see.

An unrolled outcome says whether the slot's outcome is its nominal one; False is an error: a miss of
an obstacle, a report of a ghost. An absent slot's outcome is nominal for certain.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.latents import LatentCounts
from pemviz.simulators.latents import WrappedSimulator, begun, latent_counts, stepped
from pemviz.types import CERTAIN, Signal, SimulatorFacts, StateBatch

SLOT = "slot"
"""Signal: the number of the slot whose turn it is; there with two slots or more."""
ERROR = "slot_error_"
"""Memory, with a slot's number: whether its outcome earlier in this step is an error."""
SIGHT = "sight"
"""Beside states: the :class:`Sight` at them, which is the same in the turns of all slots."""


@dataclass(frozen=True)
class Slot:
    """A place that perception answers for at every step: an obstacle, or where a ghost may appear.

    Attributes:
        name: For results and views, e.g. ``lead car``.
        nominal: The harmless outcome: True for an obstacle, which is detected; False for a ghost,
            where nothing is and nothing is reported.
        signals: Names of the signals that are about this slot alone. Proposals then look at these
            in the slot's turn, and at all signals that are no slot's. As many for every slot, or
            none, and in the same order, since slots share a proposal's coefficients.
    """

    name: str
    nominal: bool = True
    signals: tuple[str, ...] = ()


@runtime_checkable
class SlotSimulator(SimulatorFacts, Protocol):
    """A scenario that moves given, at each step, what perception reports in each of K slots.

    Like :class:`pemviz.types.Simulator`, whose members it shares; ``initial`` and ``step`` are
    pure. It may have a method ``reacts``, from signals ``[...]`` to whether it matters to the
    scenario what is reported in each slot, ``[..., K]``: proposals leave the other outcomes to the
    error model, which saves weight.
    For speed it may have ``sight``, evaluated in place of ``present`` and ``salient``, and
    ``reacts_in``, in place of ``reacts``: :class:`SeesAtOnce`, :class:`ReactsInSlot`.
    """

    @property
    def slots(self) -> tuple[Slot, ...]:
        """The K slots, at least one."""
        ...

    def initial(self, *, count: int) -> StateBatch:
        """``count`` copies of the state in which every rollout starts, arrays ``[count]``."""
        ...

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """The next states, given perception's outcomes ``[N, K]`` at ``states``."""
        ...

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Signals ``[...]`` to whether perception may report something else than nominal there.

        For an obstacle: it is in view; for a ghost: one could appear. ``[..., K]``; what is absent
        is left out, whatever its salient variables.
        """
        ...


@runtime_checkable
class SaysWhereItReacts(Protocol):
    """A scenario with slots that knows where what is reported in them matters."""

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Signals ``[...]`` to whether the outcome in each slot may matter, ``[..., K]``."""
        ...


class Sight(Protocol):
    """What perception of all slots depends on at states ``[...]``."""

    @property
    def present(self) -> BoolArray:
        """As :meth:`SlotSimulator.present`, ``[..., K]``."""
        ...

    @property
    def salient(self) -> FloatArray:
        """As :meth:`SlotSimulator.salient`, ``[..., K, D]``."""
        ...


@runtime_checkable
class SeesAtOnce(Protocol):
    """A scenario with slots whose presence and salient variables come of the same numbers."""

    def sight(self, signals: Mapping[str, FloatArray]) -> Sight:
        """Both, for signals ``[...]``."""
        ...


@runtime_checkable
class ReactsInSlot(Protocol):
    """A scenario that tells of a single slot where what is reported in it matters."""

    def reacts_in(self, slot: int, signals: Mapping[str, FloatArray]) -> BoolArray:
        """As :meth:`SaysWhereItReacts.reacts` of the slot with that number, ``[...]``."""
        ...


@runtime_checkable
class BringsSlotModels(Protocol):
    """A scenario that itself says how likely some of its slots are reported, as of a ghost."""

    @property
    def slot_models(self) -> Mapping[str, Any]:
        """Detector models, each with ``logit(salient)``, by the slot's name."""
        ...


@dataclass(frozen=True)
class WrappedSlots(WrappedSimulator):
    """The same scenario with slots, of whose states something more is known."""

    scenario: SlotSimulator  # pyright: ignore[reportIncompatibleVariableOverride]  one of slots

    @property
    def slots(self) -> tuple[Slot, ...]:
        """The scenario's slots."""
        return self.scenario.slots

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where perception has something to report, ``[..., K]``."""
        return self.scenario.present(signals)


@dataclass(frozen=True)
class UnrolledSimulator:
    """A scenario with slots as one with a single outcome a step.

    Attributes:
        scenario: The scenario with K slots.
    """

    scenario: SlotSimulator

    @property
    def slots(self) -> tuple[Slot, ...]:
        """The K slots."""
        return self.scenario.slots

    @property
    def turns(self) -> int:
        """Unrolled steps in a step: K."""
        return len(self.scenario.slots)

    @property
    def name(self) -> str:
        """The scenario's name."""
        return self.scenario.name

    @property
    def states(self) -> int:
        """Unrolled states in a rollout: K (T - 1) + 1."""
        return self.turns * (self.scenario.states - 1) + 1

    @property
    def dt_s(self) -> float:
        """Time between two outcomes of one slot [s]."""
        return self.scenario.dt_s

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The scenario's signals and, with two slots or more, whose turn it is."""
        own = self.scenario.signals
        if self.turns == 1:
            return own
        return (*own, Signal(name=SLOT, key=SLOT, unit="", low=0.0, high=float(self.turns)))

    @property
    def latents(self) -> LatentCounts:
        """The scenario's; it takes a step's noise with the last slot's turn."""
        return latent_counts(self.scenario)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The scenario's initial states, in the first slot's turn."""
        states = begun(self.scenario, count=count, start=start)
        none = np.zeros(count, dtype=np.bool_)
        return self._in_turn(states, dict.fromkeys(self._errors, none), turn=0, step=states.step)

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The states after a turn whose outcome is nominal where ``detected [N]``."""

        def move(own: StateBatch, reported: BoolArray) -> StateBatch:
            return stepped(self.scenario, own, reported, noise)

        return self.turned(states, detected, move)

    def turned(
        self,
        states: StateBatch,
        detected: BoolArray,
        move: Callable[[StateBatch, BoolArray], StateBatch],
    ) -> StateBatch:
        """The same where ``move`` leads from the scenario's states and outcomes ``[N, K]`` on."""
        turn = int(states.step) % self.turns
        error = ~(detected | states.memory[CERTAIN])
        sight = self._sight(states)
        own = replace(self.declared(states), beside={SIGHT: sight})
        errors = {name: states.memory[name] for name in self._errors}
        if turn < self.turns - 1:
            errors[f"{ERROR}{turn}"] = error
            return self._in_turn(own, errors, turn=turn + 1, step=states.step + 1)
        by_slot = np.stack([*errors.values(), error], axis=-1)
        after = move(own, by_slot ^ self.nominal)
        if after.beside.get(SIGHT) is sight:  # handed on with the rest of the states before
            after = replace(after, beside={})
        none = np.zeros(detected.shape, dtype=np.bool_)
        return self._in_turn(after, dict.fromkeys(errors, none), turn=0, step=states.step + 1)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The slot's salient variables, whether it is present, its number, ``[..., D + 2]``."""
        slot, sight = self.slot_of(signals), self._looked(signals)
        salient = np.take_along_axis(sight.salient, slot[..., None, None], axis=-2)
        present = np.take_along_axis(sight.present, slot[..., None], axis=-1)
        turn = np.concatenate([present, slot[..., None]], axis=-1, dtype=np.float64)
        return np.concatenate([salient[..., 0, :], turn], axis=-1)

    def salient_at(self, states: StateBatch) -> FloatArray:
        """The same at states that are all in the turn of one slot, ``[N, D + 2]``."""
        turn, sight = self.turn_at(states), self._sight(states)
        if turn is None:
            return self.salient(states.signals)
        own = sight.salient[..., turn, :]
        result = np.empty((*own.shape[:-1], own.shape[-1] + 2))
        result[..., :-2] = own
        result[..., -2] = sight.present[..., turn]
        result[..., -1] = turn
        return result

    @property
    def nominal(self) -> BoolArray:
        """Each slot's nominal outcome, ``[K]``."""
        return np.array([slot.nominal for slot in self.slots], dtype=np.bool_)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether the scenario reacts to the slot's outcome, ``[...]``; True if it does not say."""
        slot = self.slot_of(signals)
        if not isinstance(self.scenario, SaysWhereItReacts):
            return np.ones(slot.shape, dtype=np.bool_)
        reacts = self.scenario.reacts(self._own(signals))
        return np.take_along_axis(reacts, slot[..., None], axis=-1)[..., 0]

    def reacts_at(self, states: StateBatch) -> BoolArray:
        """The same at states, ``[...]``."""
        turn = self.turn_at(states)
        if turn is None or not isinstance(self.scenario, ReactsInSlot):
            return self.reacts(states.signals)
        return self.scenario.reacts_in(turn, states.signals)

    def turn_at(self, states: StateBatch) -> int | None:
        """The number of the slot whose turn it is at all of the states; ``None`` if they differ."""
        return int(states.step) % self.turns if np.ndim(states.step) == 0 else None

    def slot_of(self, signals: Mapping[str, FloatArray]) -> IntArray:
        """Whose turn it is at unrolled states, ``[...]``."""
        if self.turns == 1:
            return np.zeros(next(iter(signals.values())).shape, dtype=np.int64)
        return signals[SLOT].astype(np.int64)

    def declared(self, states: StateBatch) -> StateBatch:
        """Unrolled states as the scenario knows them; what wraps it may add to their memory."""
        return StateBatch(
            step=states.step // self.turns,
            signals=self._own(states.signals),
            memory={n: v for n, v in states.memory.items() if not self.is_own(n)},
        )

    def seen(self, states: StateBatch) -> StateBatch:
        """Unrolled states with what perception depends on at them beside."""
        return replace(states, beside={**states.beside, SIGHT: self._sight(states)})

    @staticmethod
    def is_own(name: str) -> bool:
        """Whether a memory of that name is one that unrolling adds."""
        return name == CERTAIN or name.startswith(ERROR)

    @property
    def _errors(self) -> tuple[str, ...]:
        return tuple(f"{ERROR}{slot}" for slot in range(self.turns - 1))

    def _own(self, signals: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """The scenario's own signals alone."""
        return {name: signals[name] for name in self._names}

    @cached_property
    def _names(self) -> tuple[str, ...]:
        return tuple(signal.name for signal in self.scenario.signals)

    def _sight(self, states: StateBatch) -> Sight:
        """Of unrolled states, or the scenario's, which may know it."""
        known: Sight | None = states.beside.get(SIGHT)
        return self._looked(states.signals) if known is None else known

    def _looked(self, signals: Mapping[str, FloatArray]) -> Sight:
        own = self._own(signals)
        if isinstance(self.scenario, SeesAtOnce):
            return self.scenario.sight(own)
        return cast(Sight, _EvaluatedSight(self.scenario, own))  # cached properties are properties

    def _in_turn(
        self, states: StateBatch, errors: Mapping[str, AnyArray], *, turn: int, step: Any
    ) -> StateBatch:
        sight = self._sight(states)
        shown = {SLOT: np.full(states.shape, float(turn))} if self.turns > 1 else {}
        return StateBatch(
            step=step,
            signals={**states.signals, **shown},
            memory={**states.memory, **errors, CERTAIN: ~sight.present[..., turn]},
            beside={SIGHT: sight},
        )


class _EvaluatedSight:
    """What a scenario says of signals, evaluated once."""

    def __init__(self, scenario: SlotSimulator, signals: Mapping[str, FloatArray]) -> None:
        self._scenario, self._signals = scenario, signals

    @cached_property
    def present(self) -> BoolArray:
        return self._scenario.present(self._signals)

    @cached_property
    def salient(self) -> FloatArray:
        return self._scenario.salient(self._signals)
