"""Gymnasium environments as they come: reset and stepped, nothing of them is kept."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.gymnasium_adapter import (
    Environment,
    detection_action,
    detections_action,
    of_slots,
    signal_values,
)
from pemviz.simulators.slots import Slot
from pemviz.types import Signal


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumEpisodes:
    """One environment as a :class:`pemviz.EpisodicSimulator`: a step of it for each step.

    It needs no ``get_state`` and is never copied, but must begin in the same state after each
    reset with ``seed``, and do the same again for the same actions.

    Attributes:
        environment: The environment.
        signals: What specifications may name.
        observe: An observation to the signals' values by name.
        states: States in a rollout (T).
        dt_s: Time between two states [s].
        salient_of: Signals ``[...]`` to what the detector's answer depends on ``[..., D]``.
        action_of: Perception's outcome to the environment's action.
        seed: The environment is reset with.
        name: For files and tables.
    """

    environment: Environment
    signals: tuple[Signal, ...]
    observe: Callable[[Any], Mapping[str, float]]
    states: int
    dt_s: float
    salient_of: Callable[[Mapping[str, FloatArray]], FloatArray] = signal_values
    action_of: Callable[[Any], Any] = detection_action
    seed: int = 0
    name: str = "gymnasium"

    def reset(self) -> Mapping[str, float]:
        """The signals after a reset."""
        return self.observe(self.environment.reset(seed=self.seed)[0])

    def step(self, outcome: Any) -> tuple[Mapping[str, float], bool]:
        """The signals after an outcome, and whether the episode is terminated or truncated."""
        answer = self.environment.step(self.action_of(outcome))
        return self.observe(answer[0]), bool(answer[2] or answer[3])

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """What the detector's answer depends on, ``[..., D]``."""
        return self.salient_of({signal.name: signals[signal.name] for signal in self.signals})


@dataclass(frozen=True, kw_only=True, eq=False)
class GymnasiumSlotEpisodes(GymnasiumEpisodes):
    """The same for K obstacles or ghosts a step, with a vector or a dict of outcomes as action.

    Attributes:
        slots: The K slots.
        salient_of: Signals ``[...]`` to each slot's salient variables, ``[..., K, D]``; if it is
            left out, these are its own signals.
        action_of: Perception's outcomes, K of them, to the environment's action; see
            :func:`named_detections_action` for a dict.
        present_of: Signals ``[...]`` to where perception has something to answer, ``[..., K]``;
            ``None``: everywhere.
        reacts_of: Signals ``[...]`` to where the environment reacts to what is detected,
            ``[..., K]``; ``None``: it may everywhere.
    """

    slots: tuple[Slot, ...]
    action_of: Callable[[Any], Any] = detections_action
    present_of: Callable[[Mapping[str, FloatArray]], BoolArray] | None = None
    reacts_of: Callable[[Mapping[str, FloatArray]], BoolArray] | None = None

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


def named_detections_action(
    slots: Sequence[Slot],
) -> Callable[[Sequence[bool]], dict[str, int]]:
    """Perception's outcomes to the action of an environment whose action space is a ``Dict``.

    Args:
        slots: Their names are the dict's keys, each a ``Discrete(2)``: 1 where detected.
    """
    names = [slot.name for slot in slots]
    return lambda detected: dict(zip(names, map(int, detected), strict=True))
