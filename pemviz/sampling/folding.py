"""From unrolled rollouts, an outcome a step, to the scenario's own steps with all slots, and back.

Methods, and what is computed from their rollouts' likelihoods, know unrolled rollouts alone;
specifications, observers and files know the scenario's own steps alone. This is where one becomes
the other: unrolled state K t + k is the k-th slot's turn at step t, and an outcome that is not
nominal is an error. Nothing is lost by it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.sampling.problem import FinishedStage
from pemviz.sampling.slots import unrolled
from pemviz.sampling.state.violated import Monitor
from pemviz.simulators.slots import ERROR, SLOT, UnrolledSimulator
from pemviz.types import (
    CERTAIN,
    LAST,
    LAST_OUTCOME,
    RolloutBatch,
    ScoredRollouts,
    Signal,
    Simulator,
)

Signals = Mapping[str, FloatArray]
Finished = Callable[[int, int], FinishedStage | None]


@dataclass(frozen=True)
class Folding:
    """Rollouts of a scenario with slots in its own steps.

    Attributes:
        simulator: The scenario, unrolled.
        remembers: Whether its unrolled states say what each slot's last outcome was.
    """

    simulator: UnrolledSimulator
    remembers: bool = False

    @property
    def turns(self) -> int:
        """Unrolled steps in a step: K."""
        return self.simulator.turns

    def signals(self, signals: Signals) -> Signals:
        """Signals ``[N, T]`` of unrolled ones ``[N, K (T-1) + 1]``."""
        return {s.name: signals[s.name][:, :: self.turns] for s in self.simulator.scenario.signals}

    def scored(self, scored: ScoredRollouts) -> ScoredRollouts:
        """Rollouts with outcomes ``[N, T-1, K]``, or ``[N, T-1]`` with one slot."""
        return replace(scored, rollouts=self.folded(scored.rollouts))

    def finished(self, finished: Finished) -> Finished:
        """What an interrupted run left of its stages, unrolled."""

        def unrolled_stage(repetition: int, stage: int) -> FinishedStage | None:
            left = finished(repetition, stage)
            if left is None:
                return None
            rollouts = self.unrolled(left.scored.rollouts)
            return replace(left, scored=replace(left.scored, rollouts=rollouts))

        return unrolled_stage

    def folded(self, rollouts: RolloutBatch) -> RolloutBatch:
        """Rollouts in the scenario's own steps; outcomes are what perception reported."""
        nominal, sign = self.simulator.nominal, self._sign
        return RolloutBatch(
            signals=self.signals(rollouts.signals),
            memory={
                name: values[:, :: self.turns]
                for name, values in rollouts.memory.items()
                if not (UnrolledSimulator.is_own(name) or name.startswith(LAST))
            },
            detected=self._by_slot(rollouts.detected) ^ ~nominal,
            pem_logit=self._by_slot(rollouts.pem_logit) * sign,
            proposal_logit=self._by_slot(rollouts.proposal_logit) * sign,
            latents=rollouts.latents,  # a step's, however many turns it has
        )

    def unrolled(self, rollouts: RolloutBatch) -> RolloutBatch:
        """The inverse of :meth:`folded`."""
        turns, nominal = self.turns, self.simulator.nominal
        count, steps = rollouts.detected.shape[:2]
        right = (rollouts.detected ^ ~nominal).reshape(count, steps, turns)
        present = np.asarray(self.simulator.scenario.present(rollouts.signals))
        error = ~right & present[:, :-1]
        memory = {name: self._repeated(values) for name, values in rollouts.memory.items()}
        memory[CERTAIN] = self._turn_by_turn(~present)
        for slot in range(turns - 1):
            before = np.where(np.arange(turns) > slot, error[..., slot, None], False)
            memory[f"{ERROR}{slot}"] = self._turn_by_turn(_with_last(before))
        signals = {name: self._repeated(values) for name, values in rollouts.signals.items()}
        if turns > 1:
            signals[SLOT] = np.tile(np.arange(float(turns)), (count, steps + 1))
            signals[SLOT] = signals[SLOT][:, : turns * steps + 1]
        if self.remembers:
            signals |= self._last_outcomes(right, present, memory)
        return RolloutBatch(
            signals=signals,
            memory=memory,
            detected=right.reshape(count, -1),
            pem_logit=(rollouts.pem_logit * self._sign).reshape(count, -1),
            proposal_logit=(rollouts.proposal_logit * self._sign).reshape(count, -1),
            latents=rollouts.latents,
        ).map(np.asfortranarray)

    def _last_outcomes(
        self, right: BoolArray, present: BoolArray, memory: dict[str, AnyArray]
    ) -> Signals:
        """The signal that shows a slot's last outcome in its turn; what is kept, into memory."""
        turns = self.turns
        now = np.where(present[:, :-1], np.where(right, 1.0, -1.0), 0.0)
        now, before = _with_last(now), np.insert(now, 0, 0.0, axis=1)
        for slot in range(turns):
            over = np.arange(turns) > slot
            kept = np.where(over, now[..., slot, None], before[..., slot, None])
            memory[f"{LAST}{slot}"] = self._turn_by_turn(kept)
        return {LAST_OUTCOME.name: self._turn_by_turn(np.where(present, before, 0.0))}

    @property
    def _sign(self) -> FloatArray:
        """Turns logits of 'detected' into such of 'nominal', and back, ``[K]``."""
        return np.where(self.simulator.nominal, 1.0, -1.0)

    def _by_slot(self, values: AnyArray) -> AnyArray:
        """``[N, T-1, K]`` of ``[N, K (T-1)]``; each slot's step of all rollouts in one piece."""
        if self.turns == 1:
            return values
        return values.T.reshape(-1, self.turns, len(values)).transpose(2, 0, 1)

    def _repeated(self, values: AnyArray) -> AnyArray:
        """Values ``[N, T]`` at unrolled states, ``[N, K (T-1) + 1]``."""
        last = self.turns * (values.shape[1] - 1) + 1
        return np.repeat(values, self.turns, axis=1)[:, :last]

    def _turn_by_turn(self, values: AnyArray) -> AnyArray:
        """Values ``[N, T, K]`` of all turns at unrolled states, ``[N, K (T-1) + 1]``."""
        last = self.turns * (values.shape[1] - 1) + 1
        return values.reshape(len(values), -1)[:, :last]


@dataclass(frozen=True)
class StepMonitor:
    """A monitor of the scenario's own steps, on unrolled ones: nothing new is seen between them.

    Attributes:
        monitor: Of the scenario's own steps.
        turns: Unrolled steps in a step.
    """

    monitor: Monitor
    turns: int

    def start(self, *, count: int) -> Any:
        """What is known of ``count`` rollouts before their first state."""
        return self.monitor.start(count=count)

    def advance(self, known: Any, *, step: int, signals: Signals) -> Any:
        """What is known with the states of an unrolled ``step`` too, signals ``[N]``."""
        if step % self.turns:
            return known
        return self.monitor.advance(known, step=step // self.turns, signals=signals)

    def violated(self, known: Any) -> BoolArray:
        """Which rollouts violate the specification for certain, ``[N]``."""
        return self.monitor.violated(known)


def folding_of(simulator: Simulator) -> Folding | None:
    """How a simulator's rollouts are folded; ``None`` if it has no slots."""
    scenario = unrolled(simulator)
    if scenario is None:
        return None
    remembers = any(signal == LAST_OUTCOME for signal in simulator.signals)
    return Folding(scenario, remembers=remembers)


def declared_signals(simulator: Simulator) -> tuple[Signal, ...]:
    """The signals that specifications, observers and files know of a simulator."""
    scenario = unrolled(simulator)
    return simulator.signals if scenario is None else scenario.scenario.signals


def _with_last(values: AnyArray) -> AnyArray:
    """``[N, T, K]`` of ``[N, T-1, K]``: nothing at the last state."""
    return np.concatenate([values, np.zeros_like(values[:, :1])], axis=1)
