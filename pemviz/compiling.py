"""Plain loops over arrays, translated by numba where it is installed (``pemviz[fast]``)."""

import importlib
import importlib.util
import logging
import sys
from collections.abc import Callable
from typing import Any

LOG = logging.getLogger(__name__)


def is_installed() -> bool:
    """Whether numba is there; asked without importing it."""
    return importlib.util.find_spec("numba") is not None


def is_loaded() -> bool:
    """Whether numba has been imported, which takes 0.3 to 0.5 s."""
    return "numba" in sys.modules


def translated(function: Callable[..., Any]) -> Callable[..., Any]:
    """A decorator: the function, compiled when it is first called; as it is without numba.

    What is compiled is kept on disk: beside the source, else in the user's cache folder, and
    where neither can be written to each process compiles for itself. Importing a module that is
    decorated so imports numba.
    """
    if not is_installed():
        return function
    try:
        numba = importlib.import_module("numba")
        try:
            return numba.njit(cache=True)(function)
        except RuntimeError:  # no folder to keep it in
            return numba.njit(function)
    except Exception as error:  # an installation of others may raise anything
        LOG.warning("numba cannot be used (%s); numpy computes", error)
        return function


def is_translated(function: Callable[..., Any]) -> bool:
    """Whether `translated` found a way."""
    return hasattr(function, "py_func")
