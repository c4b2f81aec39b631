"""When the loops over rollouts' steps are compiled and loaded.

The values are numpy's to the last bit, so that it may depend on what has been asked before in
this process.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from typing import Any

from pemviz.compiling import is_installed, is_loaded, is_translated

FIRST_BY_NUMPY = 200_000_000
"""Values of signals after which importing numba, about half a second, begins to pay."""

FIRST_WHERE_LOADED = 4_000_000
"""The same where numba has been imported: what is compiled is read in some 20 ms."""


@cache
def compiled_loops() -> Any:
    """The module :mod:`pemviz.stl.loops`, compiled; ``None`` without numba, or if it fails here."""
    if not is_installed():
        return None
    loops = importlib.import_module("pemviz.stl.loops")
    return loops if loops.WIDE is not None and is_translated(loops.mean_parts) else None


class Decision:
    """Whether it is time for the loops, by how many values they would have served so far."""

    def __init__(self) -> None:
        self.values = 0.0

    def loops_for(self, values: int) -> Any:
        """The compiled loops, or ``None``; ``values`` are those to be served now."""
        self.values += values
        enough = FIRST_WHERE_LOADED if is_loaded() else FIRST_BY_NUMPY
        return compiled_loops() if self.values > enough else None


DECISION = Decision()


@contextmanager
def loops_from_the_start(wanted: bool) -> Generator[None]:
    """Within, robustness is by the loops wherever they serve, or never: to compare the two.

    Args:
        wanted: Whether by the loops, if they can be compiled here.
    """
    before, DECISION.values = DECISION.values, math.inf if wanted else -math.inf
    try:
        yield
    finally:
        DECISION.values = before
