"""Plain loops over arrays, translated by numba where it is installed (``pemviz[fast]``)."""

import importlib
import importlib.util
import logging
import sys
from collections.abc import Callable
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
            return build(partial(numba.njit, cache=True))
        except RuntimeError:  # no folder to keep it in
            return build(numba.njit)
    except Exception as error:  # an installation of others may raise anything
        LOG.warning("numba cannot be used (%s); numpy computes", error)
        return None


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
