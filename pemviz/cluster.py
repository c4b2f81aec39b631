"""A Dask cluster that works for this process; ``pemviz[sweep]`` installs what it takes."""

import contextlib
import logging
import re
from concurrent.futures import CancelledError, Executor
from importlib import import_module
from importlib.util import find_spec
from types import TracebackType
from typing import Any, Self

from pemviz._version import __version__
from pemviz.errors import ConfigError
from pemviz.faults import exception_text

CONNECT_S = 10.0
FIRST_WORKER_S = 60.0
HAS_PORT = re.compile(r":\d+|^inproc://")
INSTALL = "pip install 'pemviz[sweep]'"
LOGGERS = (
    *("distributed", "distributed.client", "distributed.core", "distributed.comm"),
    *("asyncio", "tornado.application"),
)


class Cluster:
    """The connection to a cluster's scheduler.

    What Dask logs is silenced here, as about workers that die, whose work it gives to others:
    whatever matters is told by what comes back.

    Attributes:
        address: The scheduler's.
        client: Dask's own; ``None`` unless connected.
    """

    def __init__(self, address: str) -> None:
        """Plan for the cluster whose scheduler is at ``address``; nothing is connected yet.

        Raises:
            ConfigError: That is no address, or Dask is not installed.
        """
        if not HAS_PORT.search(address):  # Dask would say so, and 20 s later that it hangs
            message = f"scheduler = {address}: cannot be reached (an address has a port, as in "
            raise ConfigError(message + "tcp://10.0.0.5:8786)")
        if find_spec("distributed") is None:
            message = f"scheduler = {address}: needs Dask; install it with {INSTALL}"
            raise ConfigError(message)
        self.address = address
        self.client: Any = None
        self._levels: dict[str, int] = {}

    def __enter__(self) -> Self:
        """Connect, and wait for a first worker.

        Raises:
            ConfigError: There is no scheduler at the address, or no worker that can be used.
        """
        import_module("distributed")  # which sets their levels
        for name in LOGGERS:
            logger = logging.getLogger(name)
            self._levels[name] = logger.level
            logger.setLevel(logging.CRITICAL)
        try:
            self.client = _connected(self.address)
            _check_versions(self.client, self.address)
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
        """Disconnect; the cluster stays."""
        if self.client is not None:
            with contextlib.suppress(Exception):  # the scheduler may be gone
                self.client.close(timeout=CONNECT_S)
        self.client = None
        for name, level in self._levels.items():
            logging.getLogger(name).setLevel(level)

    @property
    def count(self) -> int:
        """How many workers there are now; 1 if that cannot be told."""
        with contextlib.suppress(Exception):  # the scheduler may be gone
            return max(1, len(self.client.nthreads()))
        return 1

    @property
    def is_there(self) -> bool:
        """Whether the scheduler is; not once the client has tried for long to reach it again.

        What is handed in while it tries is never done, nor given up.
        """
        return self.client.status in ("running", "connecting")

    def executor(self) -> Executor:
        """The connected cluster as an executor of any functions."""
        return self.client.get_executor(pure=False)


def worker_was_killed(error: BaseException) -> bool:
    """Whether a call ended so many of a cluster's workers that its scheduler gave up."""
    return type(error).__name__ == "KilledWorker"


def scheduler_is_gone(error: BaseException) -> bool:
    """Whether a call was given up as there is no connection to its cluster's scheduler."""
    return isinstance(error, CancelledError) or type(error).__name__ == "ClosedClientError"


def worker_version() -> str:
    """Of pemviz, where this is called."""
    return __version__


def _connected(address: str) -> Any:
    from distributed import Client  # noqa: PLC0415

    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError) as error:
        message = f"scheduler = {address}: cannot be reached ({exception_text(error)})"
        raise ConfigError(message) from error


def _check_versions(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
    except TimeoutError as error:
        message = f"scheduler = {address}: no worker came within {FIRST_WORKER_S:g} s"
        raise ConfigError(message) from error
    versions: dict[str, Any] = client.run(worker_version, on_error="return")
    for worker, version in versions.items():
        if isinstance(version, BaseException):
            version = f"unknown ({exception_text(version)})"  # noqa: PLW2901
        if version != __version__:
            message = f"scheduler = {address}: worker {worker} has pemviz {version}, not "
            raise ConfigError(message + __version__)
