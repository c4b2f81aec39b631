"""The families' loops, compiled by numba where it is installed and they are asked often enough."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import FunctionType
from typing import Any

from pemviz.compiling import LoadedInTime, with_numba
from pemviz.simulators.families import loops, sight_loops

WORTH_LOADING = 3_000_000
"""Rows, counted as below, that take numpy about a second: twice what loading the loops takes."""
WORTH_READING = 200_000
"""The same where numba has been imported: what is compiled is read in some 50 ms."""
A_CALL = 700
"""Rows that take numpy as long as a call of its functions for none."""


@dataclass(frozen=True)
class FamilyLoops:
    """The functions of :mod:`~pemviz.simulators.families.loops`, and ``sight_loops``."""

    move: Callable[..., None]
    judge: Callable[..., None]
    see: Callable[..., None]
    describe: Callable[..., None]


PLAIN = FamilyLoops(loops.move, loops.judge, sight_loops.see, sight_loops.describe)
"""The same, not compiled."""


@cache
def compiled_loops() -> FamilyLoops | None:
    """The compiled functions; ``None`` without numba, or with one that fails here."""
    return with_numba(_translated)


ROWS_MOVED = LoadedInTime(compiled_loops, WORTH_LOADING, WORTH_READING)
"""By how many states were stepped or looked at."""


def loops_for(rows: int) -> FamilyLoops | None:
    """The loops, where they have become worth it; ``None``: numpy is to compute.

    Args:
        rows: States that are to be stepped or looked at.
    """
    return ROWS_MOVED.loops_for(rows + A_CALL)


def _translated(njit: Callable[..., Any]) -> FamilyLoops:
    """All functions by one compiler; what they call of their own module they call compiled."""
    compiler, called = njit(error_model="numpy"), dict[str, Any]()

    def translated(function: Any) -> Any:
        names = {**function.__globals__, **called}
        return compiler(FunctionType(function.__code__, names, function.__name__))

    for helper in (
        loops.touch, loops.is_ahead, loops.distance_margin, loops.avoidable_by,
        loops.drive, loops.carry, loops.stop, loops.reason, sight_loops.place, sight_loops.covered,
    ):  # fmt: skip
        called[helper.__name__] = translated(helper)
    return FamilyLoops(*map(translated, (PLAIN.move, PLAIN.judge, PLAIN.see, PLAIN.describe)))
