"""What to measure next: labels for a target, labels for the refits, tracked sequences for tau."""

from dataclasses import dataclass

from pemviz.analysis.label_plan import LabelPlan
from pemviz.analysis.refit_plan import RefitBand
from pemviz.analysis.sequence_plan import SequencePlan


@dataclass(frozen=True)
class DataPlan:
    """What evidence would narrow an answer, and how much of it that takes.

    Attributes:
        labels: Labels that would show a target; ``None`` for the ``reason``.
        halves: Whether the target is not one that was asked for, but lies halfway, in powers of
            ten, from the answer to what the labels at hand allow.
        reason: Why there is no plan for labels; ``None`` where there is one.
        refits: Labels that would halve the range over refits, by band; empty where not known.
        sequences: Tracked sequences that would fix the memory time; ``None`` where not known.
    """

    labels: LabelPlan | None
    halves: bool
    reason: str | None
    refits: tuple[RefitBand, ...]
    sequences: SequencePlan | None
