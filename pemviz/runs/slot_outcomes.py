"""Perception's outcomes a step, also of scenarios with several slots: whether none of them errs."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.slots import Slot, SlotSimulator
from pemviz.types import Simulator


def slots_of(simulator: Simulator | SlotSimulator) -> tuple[Slot, ...]:
    """The scenario's slots; none where perception answers one thing a step."""
    return simulator.slots if isinstance(simulator, SlotSimulator) else ()


def faultless(detected: BoolArray, *, slots: Sequence[Slot]) -> BoolArray:
    """Whether no slot errs, a step each.

    Args:
        detected: ``[..., T-1]``, with several slots ``[..., T-1, K]``.
        slots: The scenario's; without any, an outcome of False is an error.
    """
    if not slots:
        return detected
    right = detected == _nominal(slots)
    return np.all(right, axis=-1) if len(slots) > 1 else right


def right_by_slot(detected: BoolArray, *, slots: Sequence[Slot]) -> Mapping[str, BoolArray]:
    """Whether each of several slots does not err, ``[T-1]`` by its name; empty without several.

    Args:
        detected: Of one rollout, ``[T-1, K]``.
        slots: The scenario's.
    """
    if len(slots) < 2:
        return {}
    right = detected == _nominal(slots)
    return {slot.name: np.array(right[:, place]) for place, slot in enumerate(slots)}


def faultless_probability(logit: FloatArray, *, slots: Sequence[Slot]) -> FloatArray:
    """Probability that no slot errs, a step each; shapes as :func:`faultless` has them.

    Args:
        logit: Of 'detected'.
        slots: The scenario's.
    """
    if not slots:
        return np.asarray(expit(logit))
    right = np.asarray(expit(np.where(_nominal(slots), logit, -logit)))
    return np.prod(right, axis=-1) if len(slots) > 1 else right


def _nominal(slots: Sequence[Slot]) -> BoolArray:
    nominal = np.array([slot.nominal for slot in slots], dtype=np.bool_)
    return nominal if len(slots) > 1 else nominal[0]
