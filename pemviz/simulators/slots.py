"""Several obstacles or ghosts a step: slots, which take turns within the step.

Perception answers for every slot of a step. An unrolled step is one slot's turn: the error model
is asked about that slot, its outcome is kept in the state's memory, and with the last slot's turn
the scenario moves. A scenario with K slots thereby is one with a single outcome a step, and what is
a function of the state, such as what the slots before it brought in the same step, methods see.

An unrolled outcome says whether the slot's outcome is its nominal one; False is an error: a miss of
an obstacle, a report of a ghost. An absent slot's outcome is nominal for certain.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.latents import LatentCounts
from pemviz.simulators.latents import begun, latent_counts, stepped
from pemviz.types import CERTAIN, Signal, StateBatch

SLOT = "slot"
"""Signal: the number of the slot whose turn it is; there with two slots or more."""
ERROR = "slot_error_"
"""Memory, with a slot's number: whether its outcome earlier in this step is an error."""


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
class SlotSimulator(Protocol):
    """A scenario that moves when told, at each step, what perception reports in each of K slots.

    Like :class:`pemviz.types.Simulator`, whose members it shares; ``initial`` and ``step`` are
    pure. It may have a method ``reacts``, from signals ``[...]`` to whether it matters to the
    scenario what is reported in each slot, ``[..., K]``: proposals leave the other outcomes to the
    error model, which saves weight.
    """

    @property
    def name(self) -> str:
        """Back end's name for files and tables."""
        ...

    @property
    def states(self) -> int:
        """States in a rollout (T); perception acts at the first T - 1 of them."""
        ...

    @property
    def dt_s(self) -> float:
        """Time between two states [s]."""
        ...

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The signals that a state carries."""
        ...

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

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Signals ``[...]`` to what perception of each slot depends on, ``[..., K, D]``."""
        ...

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Signals ``[...]`` to whether perception may report something else than nominal there.

        For an obstacle: it is in view; for a ghost: one could appear. ``[..., K]``; what is absent
        is not asked about, whatever its salient variables.
        """
        ...


@runtime_checkable
class SaysWhereItReacts(Protocol):
    """A scenario with slots that knows where what is reported in them matters."""

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Signals ``[...]`` to whether the outcome in each slot may matter, ``[..., K]``."""
        ...


@runtime_checkable
class BringsSlotModels(Protocol):
    """A scenario that itself says how likely some of its slots are reported, as of a ghost."""

    @property
    def slot_models(self) -> Mapping[str, Any]:
        """Detector models, each with ``logit(salient)``, by the slot's name."""
        ...


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
        turn = int(states.step) % self.turns
        error = ~(detected | states.memory[CERTAIN])
        own = self.declared(states)
        errors = {name: states.memory[name] for name in self._errors}
        if turn < self.turns - 1:
            errors[f"{ERROR}{turn}"] = error
            return self._in_turn(own, errors, turn=turn + 1, step=states.step + 1)
        by_slot = np.stack([*errors.values(), error], axis=-1)
        after = stepped(self.scenario, own, by_slot ^ self.nominal, noise)
        none = np.zeros(detected.shape, dtype=np.bool_)
        return self._in_turn(after, dict.fromkeys(errors, none), turn=0, step=states.step + 1)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The slot's salient variables, whether it is present, its number, ``[..., D + 2]``."""
        own = {signal.name: signals[signal.name] for signal in self.scenario.signals}
        slot = self.slot_of(signals)
        salient = np.take_along_axis(self.scenario.salient(own), slot[..., None, None], axis=-2)
        present = np.take_along_axis(self.scenario.present(own), slot[..., None], axis=-1)
        asked = np.concatenate([present, slot[..., None]], axis=-1, dtype=np.float64)
        return np.concatenate([salient[..., 0, :], asked], axis=-1)

    @property
    def nominal(self) -> BoolArray:
        """Each slot's nominal outcome, ``[K]``."""
        return np.array([slot.nominal for slot in self.slots], dtype=np.bool_)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether the scenario reacts to the slot's outcome, ``[...]``; True if it does not say."""
        slot = self.slot_of(signals)
        if not isinstance(self.scenario, SaysWhereItReacts):
            return np.ones(slot.shape, dtype=np.bool_)
        own = {signal.name: signals[signal.name] for signal in self.scenario.signals}
        return np.take_along_axis(self.scenario.reacts(own), slot[..., None], axis=-1)[..., 0]

    def slot_of(self, signals: Mapping[str, FloatArray]) -> IntArray:
        """Whose turn it is at unrolled states, ``[...]``."""
        if self.turns == 1:
            return np.zeros(next(iter(signals.values())).shape, dtype=np.int64)
        return signals[SLOT].astype(np.int64)

    def declared(self, states: StateBatch) -> StateBatch:
        """Unrolled states as the scenario knows them; what wraps it may add to their memory."""
        return StateBatch(
            step=states.step // self.turns,
            signals={s.name: states.signals[s.name] for s in self.scenario.signals},
            memory={n: v for n, v in states.memory.items() if not self.is_own(n)},
        )

    @staticmethod
    def is_own(name: str) -> bool:
        """Whether a memory of that name is one that unrolling adds."""
        return name == CERTAIN or name.startswith(ERROR)

    @property
    def _errors(self) -> tuple[str, ...]:
        return tuple(f"{ERROR}{slot}" for slot in range(self.turns - 1))

    def _in_turn(
        self, states: StateBatch, errors: Mapping[str, AnyArray], *, turn: int, step: Any
    ) -> StateBatch:
        present = self.scenario.present(states.signals)[..., turn]
        shown = {SLOT: np.full(states.shape, float(turn))} if self.turns > 1 else {}
        return StateBatch(
            step=step,
            signals={**states.signals, **shown},
            memory={**states.memory, **errors, CERTAIN: ~present},
        )
