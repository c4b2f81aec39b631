"""Plain loops over arrays, translated by numba where it is installed (``pemviz[fast]``)."""

import importlib
import importlib.util
import logging
import math
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

Result = TypeVar("Result")

LOG = logging.getLogger(__name__)


def is_installed() -> bool:
    """Whether numba is there; asked without importing it."""
    return importlib.util.find_spec("numba") is not None


def is_loaded() -> bool:
    """Whether numba has been imported, which takes 0.3 to 0.5 s."""
    return "numba" in sys.modules


def with_numba(build: Callable[[Callable[..., Any]], Result]) -> Result | None:
    """What ``build`` makes of numba's compiler; ``None`` without it, or where it fails.

    What is compiled is kept on disk: beside the source, else in the user's cache folder, and
    where neither can be written to each process compiles for itself.
    """
    if not is_installed():
        return None
    try:
        numba = importlib.import_module("numba")
        try:
            return build(partial(_kept, numba.njit))
        except RuntimeError:  # no folder to keep it in
            return build(numba.njit)
    except Exception as error:  # an installation of others may raise anything
        LOG.warning("numba cannot be used (%s); numpy computes", error)
        return None


def _kept(njit: Callable[..., Any], function: Any = None, **options: Any) -> Any:
    """A function compiled by ``njit`` and kept on disk, or with ``options`` a decorator for it."""
    if function is None:
        return partial(_kept, njit, **options)
    return _forgiving(njit(cache=True, **options)(function))


def _forgiving(compiled: Any) -> Any:
    """The same, which is compiled anew where what is kept of it cannot be read.

    numba's files name the types of arguments by their modules, and are read before it is asked
    whether they belong to the source as it is: those that an earlier version left may name modules
    that have moved.
    """
    files = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if files is None:
        return compiled
    index, data = files._load_index, files._load_data

    def load_index() -> Any:
        try:
            return index()
        except Exception:  # what unpickling raises depends on what is there
            return {}

    def load_data(name: str) -> Any:
        try:
            return data(name)
        except Exception as error:
            raise OSError(str(error)) from error  # then it is as if there were none

    files._load_index, files._load_data = load_index, load_data
    return compiled


def translated(function: Callable[..., Any]) -> Callable[..., Any]:
    """A decorator: the function, compiled when it is first called; as it is without numba.

    Importing a module that is decorated so imports numba.
    """
    compiled = with_numba(lambda njit: njit(function))
    return function if compiled is None else compiled


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `translated`, and part of what calls it: for what is called at every turn of a loop."""
    compiled = with_numba(lambda njit: njit(forceinline=True)(function))
    return function if compiled is None else compiled


def is_translated(function: Callable[..., Any]) -> bool:
    """Whether `translated` found a way."""
    return hasattr(function, "py_func")


@dataclass
class LoadedInTime:
    """Compiled loops that are loaded once so much was done by numpy that it would have paid.

    What they give is what numpy gives, to the last bit, so that it may depend on what a process
    has done before.

    Attributes:
        load: Gives them; ``None`` where there are none.
        first_by_numpy: How much numpy does before numba is imported, which takes half a second.
        first_where_loaded: The same where it has been: what is compiled is read in some 20 ms.
        done: How much has been done.
    """

    load: Callable[[], Any]
    first_by_numpy: float
    first_where_loaded: float
    done: float = 0.0

    def loops_for(self, more: int) -> Any:
        """The loops, or ``None``; ``more`` is what is to be done now."""
        self.done += more
        enough = self.first_where_loaded if is_loaded() else self.first_by_numpy
        return self.load() if self.done > enough else None

    @contextmanager
    def from_the_start(self, wanted: bool) -> Generator[None]:
        """Within, the loops wherever they serve, or never: to compare the two.

        Args:
            wanted: Whether the loops, if there are any.
        """
        before, self.done = self.done, math.inf if wanted else -math.inf
        try:
            yield
        finally:
            self.done = before
