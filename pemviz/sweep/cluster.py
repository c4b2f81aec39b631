"""Runs on a Dask cluster; the only module that imports distributed."""

import contextlib
import logging
import uuid
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor, Future
from importlib.util import find_spec
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Self

from pemviz._version import __version__
from pemviz.errors import ConfigError, RunError
from pemviz.sweep.run_task import RunOutcome, RunTask, carry_out, one_line

CONNECT_S = 10.0
FIRST_WORKER_S = 60.0
RESULT_S = 60.0
QUEUED_PER_WORKER = 2  # so that a worker need not wait for the next run
INSTALL = "pip install 'pemviz[sweep]'"
LOGGERS = ("distributed", "distributed.client", "distributed.core", "distributed.comm")


class ClusterWorkers:
    """The workers of a cluster, as many as there are at any time.

    Dask gives a run whose worker dies to another one by itself. What it logs about that is
    silenced here: whatever matters comes back as an outcome.
    """

    def __init__(self, address: str) -> None:
        """Plan for the cluster whose scheduler is at ``address``; nothing is connected yet.

        Raises:
            ConfigError: Dask is not installed.
        """
        if find_spec("distributed") is None:
            message = f"scheduler = {address}: needs Dask; install it with {INSTALL}"
            raise ConfigError(message)
        self._address = address
        self._client: Any = None
        self._running: dict[Any, RunTask] = {}
        self._ended: SimpleQueue[Any] = SimpleQueue()
        self._levels: dict[str, int] = {}

    def __enter__(self) -> Self:
        """Connect, and wait for a first worker.

        Raises:
            ConfigError: There is no scheduler at the address, or no worker that can be used.
        """
        for name in LOGGERS:
            logger = logging.getLogger(name)
            self._levels[name] = logger.level
            logger.setLevel(logging.CRITICAL)
        try:
            self._client = _connected(self._address)
            _check_workers(self._client, self._address)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Call back the runs that are not done, and disconnect; the cluster stays."""
        if self._client is not None:
            # the scheduler may be gone
            with contextlib.suppress(Exception):
                if self._running and self._client.status == "running":
                    self._client.cancel(list(self._running), force=True)
            with contextlib.suppress(Exception):
                self._client.close(timeout=CONNECT_S)
        self._client, self._running = None, {}
        for name, level in self._levels.items():
            logging.getLogger(name).setLevel(level)

    @property
    def capacity(self) -> int:
        """A few runs for every worker that is there now."""
        return QUEUED_PER_WORKER * self.count

    @property
    def count(self) -> int:
        """How many workers there are now; 1 if that cannot be told."""
        with contextlib.suppress(OSError, TimeoutError):
            return max(1, len(self._client.nthreads()))
        return 1

    def executor(self) -> Executor:
        """The connected cluster as an executor of any functions."""
        return self._client.get_executor(pure=False)

    def submit(self, task: RunTask) -> None:
        """Give the run to the scheduler.

        Raises:
            RunError: It is gone.
        """
        self._require_connection()
        key = f"pemviz-{task.name}-{uuid.uuid4().hex}"
        future = self._client.submit(carry_out_on_cluster, task, key=key, pure=False)
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
        if self._client.status != "running":
            message = f"scheduler {self._address}: the connection is lost"
            raise RunError(message)


@contextlib.contextmanager
def cluster_pool(address: str) -> Generator[tuple[Callable[..., Future[Any]], int], None, None]:
    """Yield what takes a function and its arguments to a cluster's worker, and their number.

    Raises:
        ConfigError: Dask is not installed, there is no scheduler at the address, or no worker
            that can be used.
    """
    with ClusterWorkers(address) as workers:
        yield workers.executor().submit, workers.count


def carry_out_on_cluster(task: RunTask) -> RunOutcome:
    """Carry a run out on a worker, in the folder that Dask cleans up after it."""
    from distributed import get_worker  # noqa: PLC0415

    return carry_out(task, scratch=Path(get_worker().local_directory))


def worker_version() -> str:
    """Of pemviz, where this is called."""
    return __version__


def _connected(address: str) -> Any:
    from distributed import Client  # noqa: PLC0415

    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError) as error:
        message = f"scheduler = {address}: cannot be reached ({one_line(error)})"
        raise ConfigError(message) from error


def _check_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
    except TimeoutError as error:
        message = f"scheduler = {address}: no worker came within {FIRST_WORKER_S:g} s"
        raise ConfigError(message) from error
    versions: dict[str, Any] = client.run(worker_version, on_error="return")
    for worker, version in versions.items():
        if isinstance(version, BaseException):
            version = f"unknown ({one_line(version)})"  # noqa: PLW2901
        if version != __version__:
            message = f"scheduler = {address}: worker {worker} has pemviz {version}, not "
            raise ConfigError(message + __version__)
