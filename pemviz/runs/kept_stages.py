"""Every stage of a run, kept whole for whoever wants to draw or count its rollouts."""

from pemviz.runs.events import Event, RunStarted, StageDone
from pemviz.types import StageResult


class KeptStages:
    """Observer that keeps all stages; a large run's rollouts take memory accordingly.

    With ``keep = "violations"`` a large stage that is learned from may hold some of its rollouts
    alone, see :attr:`pemviz.types.StageResult.drawn`.

    Attributes:
        started: What the run told at its start; ``None`` before.
        stages: Every stage that is done, of all repetitions.
    """

    def __init__(self) -> None:
        self.started: RunStarted | None = None
        self.stages: list[StageResult] = []

    def notify(self, event: Event) -> None:
        """Keep what a stage brings; a new run replaces an earlier one."""
        match event:
            case RunStarted():
                self.started, self.stages = event, []
            case StageDone():
                self.stages.append(event.stage)
            case _:
                pass
