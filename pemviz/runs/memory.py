"""What a run assumes of how misses hang together, and what is known of it."""

from dataclasses import dataclass, replace

from pemviz.config.ranges import AtLeastZero, Confidence
from pemviz.pem import Pem
from pemviz.pem.models.cards import FittedMemory, PemCard, fitted_memory
from pemviz.sampling.bursts.curve import CurvePoint
from pemviz.sampling.state.composed import hidden_in, memory_of_pem, own_pem


@dataclass(frozen=True)
class MeasuredTau:
    """A memory time measured on video [s], with its interval, and the frailty fitted beside it.

    In results of versions that did not tell it the frailty is ``None``, as are its interval's ends
    where it was not fitted.
    """

    tau_s: AtLeastZero
    low_s: AtLeastZero
    high_s: AtLeastZero
    confidence: Confidence
    frailty: AtLeastZero | None = None
    frailty_low: AtLeastZero | None = None
    frailty_high: AtLeastZero | None = None


@dataclass(frozen=True)
class RunMemory:
    """The memory of misses behind an answer.

    Attributes:
        tau_s: Memory time that the answer is for [s]; 0: misses independent given the state.
        fitted: The error model's own memory time; ``None`` where the model was fitted to single
            frames, which tell nothing of it.
        curve: The failure probability over memory times, ascending; empty if not asked for.
        frailty: Spread of obstacles' own visibility that the answer is for; 0: all are alike.
        frailty_curve: The failure probability over frailties, likewise.
        hidden: Labels of the user's own hidden properties that the answer is for.
    """

    tau_s: AtLeastZero
    fitted: MeasuredTau | None = None
    curve: tuple[CurvePoint, ...] = ()
    frailty: AtLeastZero = 0.0
    frailty_curve: tuple[CurvePoint, ...] = ()
    hidden: tuple[str, ...] = ()

    @property
    def is_independent(self) -> bool:
        """Whether misses are independent given the state."""
        return self.tau_s == 0.0 and self.frailty == 0.0 and not self.hidden


def memory_of(pem: Pem) -> RunMemory:
    """The memory that a run with this error model assumes."""
    assumed, own = memory_of_pem(pem), own_memory(own_pem(pem))
    hidden = tuple(one.label for one in hidden_in(pem) if one.label)
    run = RunMemory(tau_s=assumed.tau_s, frailty=assumed.frailty, hidden=hidden)
    if own is None:
        return run
    low_s, high_s = own.tau_interval_s
    low, high = own.frailty_interval or (None, None)
    fitted = MeasuredTau(
        tau_s=own.memory.tau_s,
        low_s=low_s,
        high_s=high_s,
        confidence=own.confidence,
        frailty=own.memory.frailty,
        frailty_low=low,
        frailty_high=high,
    )
    return replace(run, fitted=fitted)


def own_memory(pem: Pem) -> FittedMemory | None:
    """The memory that a model's card tells of; ``None`` for a model of single frames.

    Raises:
        PemError: The card is damaged.
    """
    card: object = getattr(pem, "card", None)
    return fitted_memory(card.memory, where=pem.name) if isinstance(card, PemCard) else None
