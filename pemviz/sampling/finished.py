"""What an interrupted run left of its stages."""

from collections.abc import Mapping
from dataclasses import dataclass

from pemviz.arrays import AnyArray
from pemviz.drawn import Drawn
from pemviz.types import ScoredRollouts


@dataclass(frozen=True)
class FinishedStage:
    """What an interrupted run left of one stage.

    Attributes:
        scored: Its rollouts.
        kept: See :class:`pemviz.types.StageResult`.
        drawn: Likewise.
    """

    scored: ScoredRollouts
    kept: Mapping[str, AnyArray]
    drawn: Drawn | None = None


def nothing_finished(repetition: int, stage: int) -> FinishedStage | None:  # noqa: ARG001
    """Every stage is carried out."""
    return None
