"""One worker thread runs experiments; browsers only ask, and look at its state. Knows no viser."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pemviz.analysis.detection_curves import GAP, detection_curves, gap_grid, pem_curve
from pemviz.arrays import FloatArray
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError, PemvizError
from pemviz.panel.loading import load_run
from pemviz.panel.rollout_tables import thinned
from pemviz.panel.run_data import ProposalCurve, RunData, own_scenario
from pemviz.runs import events
from pemviz.runs.engine import run as run_engine
from pemviz.runs.experiment import build_experiment
from pemviz.runs.forecast import Progress, progress_now
from pemviz.runs.result import RunResult
from pemviz.runs.rollout_files import ROLLOUT, stage_arrays
from pemviz.runs.run_folder import create_run_folder, record
from pemviz.runs.workers import no_use, own_process
from pemviz.simulators.slots import SlotSimulator
from pemviz.types import Simulator, StageResult, numbers_of

LOG = logging.getLogger(__name__)


class Watcher:
    """Observer that publishes a run's state after every event worth showing."""

    def __init__(
        self,
        *,
        folder: Path | None,
        publish: Callable[[RunData, Progress], None],
        own: Simulator | SlotSimulator | None = None,
        workers: str = "",
    ) -> None:
        """Prepare to ``publish`` every state of the run; ``own`` as of :class:`RunData`."""
        self._started: events.RunStarted | None = None
        self._folder = folder
        self._own = own
        self._publish = publish
        self.run: RunData | None = None
        self.progress = progress_now(workers=workers)

    def notify(self, event: events.Event) -> None:
        """Publish what ``event`` adds."""
        self.progress = self.progress.after(event, now_s=time.monotonic())
        match event:
            case events.RunStarted():
                self._start(event)
            case events.StageDone():
                self._add_stage(event.stage, event.result)
            case events.RepetitionDone() | events.RunDone() | events.RunFailed():
                if self.run is not None:
                    going_on = isinstance(event, events.RepetitionDone)
                    self.run = replace(self.run, result=event.result, running=going_on)
            case events.RolloutsDone() | events.RolloutsSearched():
                pass
        if self.run is not None:
            self._publish(self.run, self.progress)

    def _start(self, event: events.RunStarted) -> None:
        self._started = event
        gap_m, detection = np.empty(0), np.empty(0)
        if self._own is None and any(signal.name == GAP for signal in event.signals):
            gap_m = gap_grid(event.simulator)
            detection = pem_curve(simulator=event.simulator, pem=event.pem, gap_m=gap_m)
        self.run = RunData(
            result=event.result,
            gap_m=gap_m,
            pem_detection=detection,
            folder=self._folder,
            running=True,
            own=self._own,
        )

    def _add_stage(self, stage: StageResult, result: RunResult) -> None:
        run, started = self.run, self._started
        if run is None or started is None:
            return
        part = stage_arrays(stage, started.signals)
        part[ROLLOUT] = numbers_of(stage.scored.rollouts.count, stage.sampled)
        self.run = replace(
            run,
            result=result,
            curves=(*run.curves, *self._curve(stage, started, run.gap_m)),
            parts=thinned((*run.parts, part), stages=result.stages),
            simulated=run.simulated + stage.count,
        )

    def _curve(
        self, stage: StageResult, started: events.RunStarted, gap_m: FloatArray
    ) -> tuple[ProposalCurve, ...]:
        if not gap_m.size or (stage.kind == "final" and stage.stage > 0):
            return ()
        curves = detection_curves(
            simulator=started.simulator,
            pem=started.pem,
            proposal=stage.sampled_from if stage.learned is None else stage.learned,
            gap_m=gap_m,
            rollouts=stage.scored.rollouts,
        )
        return (ProposalCurve(stage.repetition, stage.stage, curves.proposal),)


@dataclass(frozen=True)
class PanelState:
    """What all browsers share.

    Attributes:
        run: The run under way, or the last one; ``None`` only before the first.
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


class Controller:
    """Runs one experiment at a time; every public method returns at once, from any thread."""

    def __init__(
        self,
        recordings: Path,
        *,
        observers: Callable[[Path], Sequence[events.Observer]] | None = None,
        workers: int | None = None,
        scheduler: str | None = None,
    ) -> None:
        """Start the thread that runs them.

        Args:
            recordings: Where runs are kept.
            observers: Gives a run folder's observers, such as a recorder.
            workers: So many processes simulate, where they help.
            scheduler: The cluster does whose scheduler has this address.
        """
        self.recordings = recordings
        self._workers, self._scheduler = workers, scheduler
        self._observers = observers
        self._lock = threading.Lock()
        self._state = PanelState()
        self._stop = threading.Event()
        self._requests: queue.SimpleQueue[tuple[ExperimentConfig, bool] | None] = (
            queue.SimpleQueue()
        )
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
        """Ask for a run, kept in a folder or not; ``False`` if one is under way already.

        What is wrong with the configuration is told in the state.
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
        self._requests.put((config, keep))
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
            error = None
            try:
                self._run(*request)
            except PemvizError as wrong:
                error = " ".join(str(wrong).split())
            except BaseException as wrong:  # the server outlives whatever fails in a run
                LOG.exception("the run failed")
                error = f"the run failed: {type(wrong).__name__}: {' '.join(str(wrong).split())}"
            self._change(
                lambda state, error=error: replace(
                    state,
                    running=False,
                    stopping=False,
                    error=error,
                    finished_runs=state.finished_runs + 1,
                )
            )

    def _run(self, config: ExperimentConfig, keep: bool) -> None:
        experiment = build_experiment(config)
        own = own_scenario(experiment.declared, experiment.config)
        helps = not no_use(experiment)
        by: Any = {"workers": self._workers, "scheduler": self._scheduler} if helps else {}
        if self._workers is None and self._scheduler is None:
            by = {"workers": own_process(experiment)}
        words = "" if self._workers is None else f"by {self._workers} processes"
        words = words if self._scheduler is None else "on a cluster"
        watched: Any = {"publish": self._publish, "own": own, "workers": words if helps else ""}
        stop = self._stop.is_set
        if not keep:
            watcher = Watcher(folder=None, **watched)
            run_engine(experiment, run_id="quick look", observers=[watcher], should_stop=stop, **by)
            return
        try:
            folder = create_run_folder(self.recordings, label=config.method)
        except InputError as error:
            message = str(error).replace("out =", "recordings =", 1)
            raise InputError(message) from error
        recorders = [] if self._observers is None else self._observers(folder)
        watcher = Watcher(folder=folder, **watched)
        record(experiment, folder, recorders=recorders, observers=[watcher], should_stop=stop, **by)
        run = watcher.run
        if run is None or run.kept == run.simulated:
            return
        stored = load_run(folder)  # all that the folder keeps, as it was too large to hold
        if stored.kept > run.kept:
            whole = replace(run, parts=stored.parts, mapped=stored.mapped)
            self._change(lambda state: replace(state, run=whole))
