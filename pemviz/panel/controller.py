"""One worker thread runs experiments; browsers only ask, and look at its state. Knows no viser."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pemviz.analysis.detection_curves import GAP, detection_curves, gap_grid, pem_curve
from pemviz.arrays import FloatArray
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError, PemvizError
from pemviz.panel.loading import load_run
from pemviz.panel.rollout_tables import thinned
from pemviz.panel.run_data import ProposalCurve, RunData, own_scenario
from pemviz.runs.engine import run as run_engine
from pemviz.runs.events import (
    Event,
    Observer,
    RepetitionDone,
    RolloutsDone,
    RunDone,
    RunFailed,
    RunStarted,
)
from pemviz.runs.events import StageDone as StageDoneEvent
from pemviz.runs.experiment import build_experiment
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import ROLLOUT, stage_arrays
from pemviz.runs.store import carry_out, create_run_folder
from pemviz.sampling.registry import by_name
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Simulator, StageResult, numbers_of


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


LOG = logging.getLogger(__name__)

ObserverFactory = Callable[[Path], Sequence[Observer]]


def _no_observers(folder: Path) -> Sequence[Observer]:  # noqa: ARG001
    return ()


@dataclass(frozen=True)
class PanelState:
    """What all browsers share.

    Attributes:
        run: The run under way, or the last one; ``None`` only before the first.
        progress: Of the run under way or last.
        running: Whether an experiment runs or is about to.
        stopping: Whether it was asked to stop.
        error: Why the last experiment did not run to its end, in one line.
        version: Grows with every change.
        finished_runs: How many experiments have ended; recordings may be new.
    """

    run: RunData | None = None
    progress: Progress | None = None
    running: bool = False
    stopping: bool = False
    error: str | None = None
    version: int = 0
    finished_runs: int = 0


@dataclass(frozen=True)
class _Request:
    config: ExperimentConfig
    keep: bool
    done: threading.Event = field(default_factory=threading.Event)


class Controller:
    """Runs one experiment at a time.

    Every public method returns at once and may be called from any thread.

    Attributes:
        recordings: The folder in which runs are kept.
    """

    def __init__(self, recordings: Path, *, observers: ObserverFactory = _no_observers) -> None:
        """Start the worker.

        Args:
            recordings: Where runs are kept.
            observers: Given a run folder, further observers of the run, e.g. a recorder.
        """
        self.recordings = recordings
        self._observers = observers
        self._lock = threading.Lock()
        self._state = PanelState()
        self._stop = threading.Event()
        self._requests: queue.SimpleQueue[_Request | None] = queue.SimpleQueue()
        self._worker = threading.Thread(target=self._work, name="pemviz-engine", daemon=True)
        self._worker.start()

    @property
    def state(self) -> PanelState:
        """The present state."""
        with self._lock:
            return self._state

    def show(self, run: RunData) -> None:
        """Show a run that was loaded; for the start, before anything has run."""
        self._change(lambda state: replace(state, run=run))

    def start(self, config: ExperimentConfig, *, keep: bool = True) -> bool:
        """Ask for a run; ``False`` if one is under way already.

        Args:
            config: What to run; what is wrong with it is told in the state.
            keep: Whether to leave a run folder.
        """
        with self._lock:
            if self._state.running:
                return False
            self._stop.clear()
            self._state = replace(
                self._state,
                running=True,
                stopping=False,
                error=None,
                progress=None,
                version=self._state.version + 1,
            )
        self._requests.put(_Request(config=config, keep=keep))
        return True

    def stop(self) -> None:
        """Ask the run under way to stop; what is finished is kept."""
        self._stop.set()
        self._change(lambda state: replace(state, stopping=state.running))

    def close(self, *, timeout_s: float = 5.0) -> None:
        """Stop the run under way and end the worker."""
        self.stop()
        self._requests.put(None)
        self._worker.join(timeout_s)

    def _change(self, change: Callable[[PanelState], PanelState]) -> None:
        with self._lock:
            self._state = replace(change(self._state), version=self._state.version + 1)

    def _publish(self, run: RunData, progress: Progress) -> None:
        self._change(lambda state: replace(state, run=run, progress=progress))

    def _work(self) -> None:
        while (request := self._requests.get()) is not None:
            error = self._carry_out(request)
            self._change(
                lambda state, error=error: replace(
                    state,
                    running=False,
                    stopping=False,
                    error=error,
                    finished_runs=state.finished_runs + 1,
                )
            )

    def _carry_out(self, request: _Request) -> str | None:
        """Run; the reason in one line if it did not come to its end."""
        try:
            self._run(request)
        except PemvizError as error:
            return " ".join(str(error).split())
        except BaseException as error:  # the server outlives whatever fails in a run
            LOG.exception("the run failed")
            return f"the run failed: {type(error).__name__}: {' '.join(str(error).split())}"
        return None

    def _run(self, request: _Request) -> None:
        experiment = build_experiment(request.config)
        own = own_scenario(experiment.declared, experiment.config)
        folder = None
        observers: list[Observer] = []
        if request.keep:
            try:
                folder = create_run_folder(self.recordings, label=request.config.method)
            except InputError as error:
                message = str(error).replace("out =", "recordings =", 1)
                raise InputError(message) from error
            observers += self._observers(folder)
        watcher = Watcher(folder=folder, publish=self._publish, own=own)
        if folder is None:
            run_engine(
                experiment,
                run_id="quick look",
                observers=[watcher],
                should_stop=self._stop.is_set,
            )
        else:
            carry_out(
                experiment,
                folder,
                recorders=observers,
                observers=[watcher],
                should_stop=self._stop.is_set,
            )
            self._show_all(watcher.run, folder)

    def _show_all(self, run: RunData | None, folder: Path) -> None:
        """Show all rollouts that the folder of a run keeps, if it was too large to hold them."""
        if run is None or run.kept == run.simulated:
            return
        stored = load_run(folder)
        if stored.kept > run.kept:
            whole = replace(run, parts=stored.parts, mapped=stored.mapped)
            self._change(lambda state: replace(state, run=whole))
