"""The simulator of an experiment, and what proposals see of its states."""

from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.pem import PositionErrorModel
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.simulators.latents import begun
from pemviz.simulators.slots import ERROR, UnrolledSimulator
from pemviz.simulators.tracking.tracker import Tracker
from pemviz.types import Simulator, StateBatch

GAP = "gap"


@dataclass(frozen=True)
class BackEnd:
    """A simulator and what methods and views may know about it.

    Attributes:
        simulator: The scenario.
        features: What proposals may look at.
        twin: A fast simulator of the same scenario, if there is one.
        batch_rollouts: How many rollouts are simulated at a time.
        is_own: Whether it is the user's own or another package's.
        position_errors: Of what the shipped scenario measures; ``None``: it measures exactly.
        single_outcomes: The scenario without hidden properties; ``None``: it has none.
        surrogate: A fast simulator of about the same scenario, for methods that learn on it first.
    """

    simulator: Simulator
    features: StateFeatures
    twin: Simulator | None
    batch_rollouts: int
    is_own: bool = False
    position_errors: PositionErrorModel | None = None
    single_outcomes: "BackEnd | None" = None
    surrogate: Simulator | None = None

    @property
    def scenario_alone(self) -> "BackEnd":
        """The back end without hidden properties."""
        return self if self.single_outcomes is None else self.single_outcomes

    @property
    def farthest_m(self) -> float | None:
        """The initial gap [m], of a random one the median; ``None`` where there is no gap."""
        if all(signal.name != GAP for signal in self.simulator.signals):
            return None
        return float(np.max(begun(self.simulator, count=1).signals[GAP]))


@dataclass(frozen=True)
class SlotFeatures:
    """What proposals look at in a slot's turn; slots share a proposal's coefficients.

    These are the signals that are no slot's, the slot's own, its number, how many slots before it
    erred in this step, and the step.
    """

    simulator: UnrolledSimulator

    def values(self, states: StateBatch) -> FloatArray:
        """Numbers ``[..., D]``."""
        turns, signals = self.simulator.turns, states.signals
        slot = self.simulator.slot_of(signals)
        owned = {name for slot in self.simulator.slots for name in slot.signals}
        names = [signal.name for signal in self.simulator.scenario.signals]
        columns: list[FloatArray] = [signals[name] for name in names if name not in owned]
        for place in zip(*(slot.signals for slot in self.simulator.slots), strict=True):
            of_all = np.stack([signals[name] for name in place], axis=-1)
            columns.append(np.take_along_axis(of_all, slot[..., None], axis=-1)[..., 0])
        if turns > 1:
            errors = [states.memory[f"{ERROR}{before}"] for before in range(turns - 1)]
            columns.append(slot.astype(np.float64))
            columns.append(np.stack(errors, axis=-1).sum(axis=-1, dtype=np.float64))
        step = np.asarray(states.step // turns, dtype=np.float64)
        columns.append(np.broadcast_to(step, slot.shape))
        return np.stack(columns, axis=-1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where the scenario says that it reacts to the slot's outcome, ``[...]``."""
        return self.simulator.reacts_at(states)


@dataclass(frozen=True)
class StepFeatures:
    """Features of the user's own, which count steps as the scenario does.

    Attributes:
        features: Evaluated in every slot's turn, ``slot`` is among the signals.
        turns: Outcomes of a step.
    """

    features: StateFeatures
    turns: int

    def values(self, states: StateBatch) -> FloatArray:
        """The user's own, ``[..., D]``."""
        return self.features.values(self._in_steps(states))

    def reacts(self, states: StateBatch) -> BoolArray:
        """The user's own, ``[...]``."""
        return self.features.reacts(self._in_steps(states))

    def _in_steps(self, states: StateBatch) -> StateBatch:
        return replace(states, step=states.step // self.turns)


@dataclass(frozen=True)
class TrackFeatures:
    """What the scenario's states offer to look at, and the tracks; of a slot in its turn, its own.

    Attributes:
        features: The scenario's own.
        tracker: The tracker, whose state lies in the states' memory.
        unrolled: The scenario, if it has slots.
    """

    features: StateFeatures
    tracker: Tracker
    unrolled: UnrolledSimulator | None = None

    def values(self, states: StateBatch) -> FloatArray:
        """The scenario's features and :meth:`Tracker.numbers`, ``[..., D]``."""
        own = self.features.values(states)
        if self.unrolled is None:
            numbers = self.tracker.numbers(self.tracker.state(states.memory))
        else:
            slot = self.unrolled.slot_of(states.signals)[..., None]
            tracks = self.tracker.state(states.memory, slots=self.unrolled.turns)
            of_all = self.tracker.numbers(tracks)
            numbers = [np.take_along_axis(one, slot, axis=-1)[..., 0] for one in of_all]
        return np.concatenate((own, np.stack(numbers, -1)), -1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where the scenario may react to what is tracked, ``[...]``."""
        return self.features.reacts(states)
