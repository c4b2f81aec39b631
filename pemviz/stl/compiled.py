"""When the loops over rollouts' steps are compiled and loaded."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

from pemviz.compiling import LoadedInTime, is_installed, is_translated

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


DECISION = LoadedInTime(compiled_loops, FIRST_BY_NUMPY, FIRST_WHERE_LOADED)
"""By how many values of signals they would have served."""
