"""What a run assumes of how misses hang together, and what is known of it."""

from dataclasses import dataclass

from pemviz.config.ranges import AtLeastZero, Confidence
from pemviz.pem import Pem
from pemviz.pem.models.card import PemCard
from pemviz.pem.models.memory_card import FittedMemory, fitted_memory
from pemviz.sampling.bursts.curve import CurvePoint
from pemviz.sampling.memory import memory_of_pem, single_outcome_model


@dataclass(frozen=True)
class MeasuredTau:
    """A memory time measured on video [s], with its interval."""

    tau_s: AtLeastZero
    low_s: AtLeastZero
    high_s: AtLeastZero
    confidence: Confidence


@dataclass(frozen=True)
class RunMemory:
    """The memory of misses behind an answer.

    Attributes:
        tau_s: Memory time that the answer is for [s]; 0: misses independent given the state.
        fitted: The error model's own memory time; ``None`` where the model was fitted to single
            frames, which tell nothing of it.
        curve: The failure probability over memory times, ascending; empty if not asked for.
    """

    tau_s: AtLeastZero
    fitted: MeasuredTau | None = None
    curve: tuple[CurvePoint, ...] = ()


def memory_of(pem: Pem) -> RunMemory:
    """The memory that a run with this error model assumes."""
    tau_s, own = memory_of_pem(pem).tau_s, own_memory(single_outcome_model(pem))
    if own is None:
        return RunMemory(tau_s=tau_s)
    low_s, high_s = own.tau_interval_s
    fitted = MeasuredTau(own.memory.tau_s, low_s, high_s, own.confidence)
    return RunMemory(tau_s=tau_s, fitted=fitted)


def own_memory(pem: Pem) -> FittedMemory | None:
    """The memory that a model's card tells of; ``None`` for a model of single frames.

    Raises:
        PemError: The card is damaged.
    """
    card: object = getattr(pem, "card", None)
    return fitted_memory(card.memory, where=pem.name) if isinstance(card, PemCard) else None
