"""One worker thread runs experiments; browsers only ask, and look at its state. Knows no viser."""

import logging
import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError, PemvizError
from pemviz.panel.loading import load_run
from pemviz.panel.run_data import RunData, own_scenario
from pemviz.panel.run_observer import Progress, Watcher
from pemviz.runs.engine import run as run_engine
from pemviz.runs.events import Observer
from pemviz.runs.experiment import build_experiment
from pemviz.runs.resume import carry_out
from pemviz.runs.store import create_run_folder

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
