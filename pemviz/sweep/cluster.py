"""Runs of a sweep on a Dask cluster."""

import contextlib
import uuid
from collections.abc import Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any

from pemviz.cluster import Cluster
from pemviz.errors import RunError
from pemviz.sweep.run_task import RunOutcome, RunTask, carry_out, one_line

RESULT_S = 60.0
QUEUED_PER_WORKER = 2  # so that a worker need not wait for the next run


class ClusterWorkers(Cluster):
    """The workers of a cluster, as many as there are at any time.

    Dask gives a run whose worker dies to another one by itself.
    """

    def __init__(self, address: str) -> None:
        """Plan for the cluster whose scheduler is at ``address``; nothing is connected yet.

        Raises:
            ConfigError: That is no address, or Dask is not installed.
        """
        super().__init__(address)
        self._running: dict[Any, RunTask] = {}
        self._ended: SimpleQueue[Any] = SimpleQueue()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Call back the runs that are not done, and disconnect; the cluster stays."""
        if self.client is not None:
            with contextlib.suppress(Exception):  # the scheduler may be gone
                if self._running and self.client.status == "running":
                    self.client.cancel(list(self._running), force=True)
        self._running = {}
        super().__exit__(kind, error, traceback)

    @property
    def capacity(self) -> int:
        """A few runs for every worker that is there now."""
        return QUEUED_PER_WORKER * self.count

    def submit(self, task: RunTask) -> None:
        """Give the run to the scheduler.

        Raises:
            RunError: It is gone.
        """
        self._require_connection()
        key = f"pemviz-{task.name}-{uuid.uuid4().hex}"
        future = self.client.submit(carry_out_on_cluster, task, key=key, pure=False)
        self._running[future] = task
        future.add_done_callback(self._ended.put)

    def finished(self, *, timeout_s: float) -> Sequence[RunOutcome]:
        """The outcomes since the last call, waiting for one if need be.

        Raises:
            RunError: The scheduler is gone.
        """
        ready: list[Any] = []
        with contextlib.suppress(Empty):
            ready.append(self._ended.get(timeout=timeout_s))
            while True:
                ready.append(self._ended.get_nowait())
        self._require_connection()
        outcomes = [self._outcome(future) for future in ready]
        return [outcome for outcome in outcomes if outcome is not None]

    def _outcome(self, future: Any) -> RunOutcome | None:
        task = self._running[future]
        try:
            outcome: RunOutcome = future.result(timeout=RESULT_S)
        except TimeoutError:  # its worker died with the result; Dask has it computed again
            self._ended.put(future)
            return None
        except Exception as error:
            self._require_connection()
            message = one_line(error)
            if type(error).__name__ == "KilledWorker":
                message = "its workers died one after the other: killed, or out of memory"
            outcome = RunOutcome(task.name, message=message)
        del self._running[future]
        future.release()
        return outcome

    def _require_connection(self) -> None:
        if self.client.status != "running":
            message = f"scheduler {self.address}: the connection is lost"
            raise RunError(message)


def carry_out_on_cluster(task: RunTask) -> RunOutcome:
    """Carry a run out on a worker, in the folder that Dask cleans up after it."""
    from distributed import get_worker  # noqa: PLC0415

    return carry_out(task, scratch=Path(get_worker().local_directory))
