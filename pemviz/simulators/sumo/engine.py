"""SUMO in this process: there is one, and whoever needs it loads what is theirs.

libsumo is imported when it is first needed: it is an extra, and takes most of a second.
"""

import os
from collections.abc import Generator, Hashable, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from threading import RLock
from typing import Any

from pemviz.errors import ConfigError, RunError

INSTALL = "pip install 'pemviz[sumo]'"
QUIET = "LIBSUMO_AS_TRACI"
"""Environment variable: with the value ``quiet`` libsumo prints nothing when it is imported."""


def is_installed() -> bool:
    """Whether libsumo is there."""
    return find_spec("libsumo") is not None


def check_installed() -> None:
    """Refuse SUMO where libsumo is not there.

    Raises:
        ConfigError: Says how to install it.
    """
    if not is_installed():
        message = f"simulator = 'sumo': needs libsumo; install it with {INSTALL}"
        raise ConfigError(message)


class Engine:
    """The process's simulation."""

    def __init__(self) -> None:
        self.lock = RLock()
        self.owner: Hashable = None
        self.library: Any = None

    @contextmanager
    def use(self, owner: Hashable, options: Sequence[str]) -> Generator[tuple[Any, bool]]:
        """Have the simulation to oneself: libsumo, and whether it was loaded anew.

        Args:
            owner: Who, or what, it is loaded for; one that still has it finds it as left.
            options: SUMO's command line, for when it has to be loaded.

        Raises:
            ConfigError: libsumo is not installed.
            RunError: SUMO does not start, or refuses something meanwhile; it is then closed.
        """
        with self.lock:
            library = self._imported()
            try:
                anew = self.owner != owner
                if anew:
                    self.close()
                    library.start(["sumo", *QUIET_OPTIONS, *options])
                    self.owner = owner
                yield library, anew
            except (library.TraCIException, library.FatalTraCIError) as error:
                self.close()
                message = f"SUMO: {_one_line(error)}"
                raise RunError(message) from error

    def close(self) -> None:
        """End the simulation, if there is one."""
        if self.owner is not None:
            self.owner = None
            self.library.close()

    def _imported(self) -> Any:
        if self.library is None:
            check_installed()
            before = os.environ.get(QUIET)
            os.environ[QUIET] = "quiet"
            try:
                import libsumo  # noqa: PLC0415  an extra
            finally:
                if before is None:
                    del os.environ[QUIET]
                else:
                    os.environ[QUIET] = before
            self.library = libsumo
        return self.library


QUIET_OPTIONS = ("--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true")
ENGINE = Engine()


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
