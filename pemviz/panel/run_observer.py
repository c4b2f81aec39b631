"""The observer that turns the engine's events into what the panel shows."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pemviz.analysis.detection_curves import GAP, detection_curves, gap_grid, pem_curve
from pemviz.arrays import FloatArray
from pemviz.drawn import numbers_of
from pemviz.panel.run_data import ProposalCurve, RunData
from pemviz.panel.tables import thinned
from pemviz.runs.events import Event, RepetitionDone, RolloutsDone, RunDone, RunFailed, RunStarted
from pemviz.runs.events import StageDone as StageDoneEvent
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import ROLLOUT, stage_arrays
from pemviz.sampling.registry import by_name
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Simulator, StageResult


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Attributes:
        repetition: Zero-based.
        repetitions: How many there are.
        stage: The stage under way, zero-based.
        stages: Stages of a repetition.
        done: Rollouts simulated.
        planned: Rollouts that the run will simulate.
        elapsed_s: Time since the start.
        by_level: Whether ``done`` and ``planned`` tell how far splitting's levels have come, and
            count no rollouts.
    """

    repetition: int
    repetitions: int
    stage: int
    stages: int
    done: int
    planned: int
    elapsed_s: float
    by_level: bool = False

    @property
    def share(self) -> float:
        """Done share of the rollouts, 0 to 1."""
        return min(self.done / self.planned, 1.0) if self.planned else 0.0

    @property
    def left_s(self) -> float | None:
        """Time left if the rest takes as long a rollout as what is done; unknown at first."""
        return self.elapsed_s * (1.0 - self.share) / self.share if self.share > 0.0 else None


Publish = Callable[[RunData, Progress], None]


class Watcher:
    """Observer that publishes a run's state after every event worth showing."""

    def __init__(
        self,
        *,
        folder: Path | None,
        publish: Publish,
        own: Simulator | SlotSimulator | None = None,
    ) -> None:
        """Prepare.

        Args:
            folder: Where the run lies on disk, if it does.
            publish: What is told of every state of the run.
            own: The scenario, if it is another than the braking scenario.
        """
        self._started: RunStarted | None = None
        self._folder = folder
        self._own = own
        self._publish = publish
        self._began_s = time.monotonic()
        self._gap_m: FloatArray = np.empty(0)
        self._done_before = 0
        self.run: RunData | None = None
        self.progress = Progress(0, 1, 0, 1, 0, 0, 0.0)

    def notify(self, event: Event) -> None:
        """Publish what ``event`` adds."""
        match event:
            case RunStarted():
                self._start(event)
            case RolloutsDone():
                self.progress = replace(
                    self.progress,
                    repetition=event.repetition,
                    stage=event.stage,
                    done=self._done_before + event.done,
                )
            case StageDoneEvent():
                self._add_stage(event.stage, event.result)
                self._set_result(event.result)
            case RepetitionDone():
                self._set_result(event.result)
            case RunDone() | RunFailed():
                self._set_result(event.result)
                if self.run is not None:
                    self.run = replace(self.run, running=False)
        elapsed_s = time.monotonic() - self._began_s
        self.progress = replace(self.progress, elapsed_s=elapsed_s)
        if self.run is not None:
            self._publish(self.run, self.progress)

    def _start(self, event: RunStarted) -> None:
        self._started = event
        if self._own is None and any(signal.name == GAP for signal in event.signals):
            self._gap_m = gap_grid(event.simulator)
            detection = pem_curve(simulator=event.simulator, pem=event.pem, gap_m=self._gap_m)
        else:
            detection = np.empty(0)
        self.progress = replace(
            self.progress,
            repetitions=event.config.repetitions,
            stages=event.stages,
            planned=event.planned_rollouts,
            by_level=by_name(event.config.method).counting == "level",
        )
        self.run = RunData(
            result=event.result,
            gap_m=self._gap_m,
            pem_detection=detection,
            folder=self._folder,
            running=True,
            own=self._own,
        )

    def _set_result(self, result: RunResult) -> None:
        if self.run is not None:
            self.run = replace(self.run, result=result)

    def _add_stage(self, stage: StageResult, result: RunResult) -> None:
        run, started = self.run, self._started
        if run is None or started is None:
            return
        count = stage.count
        self._done_before += count
        self.progress = replace(self.progress, done=self._done_before, stage=stage.stage + 1)
        part = stage_arrays(stage, started.signals)
        part[ROLLOUT] = numbers_of(stage.scored.rollouts.count, stage.drawn)
        curve = self._curve(stage, started)
        self.run = replace(
            run,
            curves=run.curves if curve is None else (*run.curves, curve),
            parts=thinned((*run.parts, part), stages=result.stages),
            simulated=run.simulated + count,
        )

    def _curve(self, stage: StageResult, started: RunStarted) -> ProposalCurve | None:
        proposal = stage.sampled_from if stage.learned is None else stage.learned
        last = stage.kind == "final" and stage.stage > 0
        if not self._gap_m.size or last:
            return None
        curves = detection_curves(
            simulator=started.simulator,
            pem=started.pem,
            proposal=proposal,
            gap_m=self._gap_m,
            rollouts=stage.scored.rollouts,
        )
        return ProposalCurve(
            repetition=stage.repetition,
            stage=stage.stage,
            kind=stage.kind,
            gap_m=self._gap_m,
            detection=curves.proposal,
        )
