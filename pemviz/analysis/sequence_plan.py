"""How many tracked sequences would fix a memory time, from what those at hand fix it to.

An interval of log tau from S independent sequences is about t_(S-1) s / sqrt(S) to either side,
with Student's t and a spread s of the sequences that more of them do not change.
"""

import math
from dataclasses import dataclass

from scipy.special import stdtrit

from pemviz.config.ranges import AtLeastZero, Count
from pemviz.pem.models.memory_card import FittedMemory

WANTED_FACTOR = 1.2
MOST_SEQUENCES = 10_000_000


@dataclass(frozen=True)
class SequencePlan:
    """Tracked sequences for a memory time.

    Attributes:
        example: Whose memory it is.
        is_own: Whether that is the run's error model; otherwise an example of a detector.
        tau_s: Its memory time [s].
        low_s: Lower end of the memory time's interval [s].
        high_s: Upper end [s].
        sequences: Independent sequences that it rests on.
        factor: What the interval is to reach to either side.
        wanted: So many sequences like these would do, those at hand included.
    """

    example: str
    is_own: bool
    tau_s: AtLeastZero
    low_s: AtLeastZero
    high_s: AtLeastZero
    sequences: Count
    factor: AtLeastZero
    wanted: Count


def sequence_plan(
    fitted: FittedMemory, *, example: str, is_own: bool, factor: float = WANTED_FACTOR
) -> SequencePlan | None:
    """How many sequences fix the memory time to within ``factor``; ``None`` if it may be 0.

    Args:
        fitted: The memory that sequences at hand tell of.
        example: The name of the model that has it.
        is_own: Whether that is the run's.
        factor: Above 1.
    """
    low_s, high_s = fitted.tau_interval_s
    if low_s <= 0.0 or high_s <= low_s:
        return None
    wanted = sequences_for(
        half_width=0.5 * math.log(high_s / low_s),
        sequences=fitted.sequences,
        wanted=math.log(factor),
        confidence=fitted.confidence,
    )
    return SequencePlan(
        example=example,
        is_own=is_own,
        tau_s=fitted.memory.tau_s,
        low_s=low_s,
        high_s=high_s,
        sequences=fitted.sequences,
        factor=factor,
        wanted=wanted,
    )


def sequences_for(*, half_width: float, sequences: int, wanted: float, confidence: float) -> int:
    """Fewest sequences whose interval is ``wanted`` wide to either side.

    Args:
        half_width: That of ``sequences``, at least two.
        sequences: How many there are.
        wanted: What is asked for, in the same unit.
        confidence: Of both intervals.
    """

    def width(count: int) -> float:
        return float(stdtrit(count - 1, 0.5 + confidence / 2.0)) / math.sqrt(count)

    scale = half_width / width(sequences)
    fewest, most = 1, 2
    while scale * width(most) > wanted and most < MOST_SEQUENCES:
        fewest, most = most, 2 * most
    while most - fewest > 1:
        middle = (fewest + most) // 2
        fewest, most = (middle, most) if scale * width(middle) > wanted else (fewest, middle)
    return min(most, MOST_SEQUENCES)
