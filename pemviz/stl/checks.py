"""Whether signals are fit to be asked a formula of; shared by the numpy and torch sides."""

from __future__ import annotations

import difflib
from collections.abc import Collection

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import InputError
from pemviz.stl.errors import FormulaError, shorten
from pemviz.stl.formulas import Formula


def unknown_signal(name: str, known: Collection[str]) -> str:
    """What to say of a signal that does not exist, with the nearest that does."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return (
        f"unknown signal {shorten(repr(name))}; {hint}known: {', '.join(sorted(known)) or 'none'}"
    )


def check_names(formula: Formula, known: Collection[str]) -> None:
    """Raises FormulaError where ``formula`` uses a signal that is not known."""
    for name in sorted(formula.signals()):
        if name not in known:
            raise FormulaError(unknown_signal(name, known))


def check_horizon(formula: Formula, states: int) -> None:
    """Raises FormulaError where ``formula`` looks past the end of a rollout of ``states``."""
    needed = formula.horizon_steps() + 1
    if needed > states:
        raise FormulaError(
            f"formula looks {needed - 1} steps ahead and needs {needed} states;"
            f" the rollouts have {states} (steps 0 to {states - 1})"
        )


def check_finite(values: FloatArray, what: str, first_rollout: int) -> None:
    """Raises InputError that names rollout and step of the first of [n, T] not finite."""
    if not np.isfinite(values).all():
        rollout, step = np.argwhere(~np.isfinite(values))[0]
        raise InputError(
            f"{what} is {values[rollout, step]} at rollout {first_rollout + rollout},"
            f" step {step}; it must be finite"
        )


def check_bounds(
    values: FloatArray, name: str, bounds: tuple[float, float], first_rollout: int
) -> None:
    """Raises InputError that names rollout and step of the first of [n, T] out of bounds."""
    low, high = bounds
    if values.size and not (values.min() >= low and values.max() <= high):
        check_finite(values, f"signal {name!r}", first_rollout)
        rollout, step = np.argwhere((values < low) | (values > high))[0]
        raise InputError(
            f"agm: signal {name!r} is {values[rollout, step]} at rollout"
            f" {first_rollout + rollout}, step {step}; declared bounds [{low:g}, {high:g}]"
            " (widen them, or choose clipping)"
        )
