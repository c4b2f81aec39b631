"""Arithmetic-geometric mean robustness: Mehdipour, Vasile & Belta, ACC 2019.

Dimensionless: a predicate's margin is divided by the width of its range, computed from
declared bounds of the signals. The metric is discontinuous where a margin is exactly 0. There a
disjunction is the dual of the conjunction: 0 if its best part is exactly 0, so that the sign is
that of classical robustness everywhere (as published it would be negative).
"""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import TypeAlias

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import InputError
from pemviz.stl.bounds import Interval, check_interval, margin_range
from pemviz.stl.errors import shorten
from pemviz.stl.expressions import Predicate
from pemviz.stl.numbers import NumberSemantics
from pemviz.stl.windows import fold, half_of, running, sliding

SCENARIO_BOUNDS: Mapping[str, Interval] = {
    "gap": (-25.0, 25.0),
    "ego_speed": (0.0, 40.0),
    "lead_speed": (0.0, 40.0),
}
"""Bounds of the braking scenario: gap in m, speeds in m/s."""


@dataclass(frozen=True)
class Agm:
    """The arithmetic-geometric mean metric.

    Attributes:
        bounds: (low, high) of every signal that a formula uses, in the signal's unit.
        clip: whether values beyond their bounds count as the bound; otherwise they
            are an error.
    """

    bounds: Mapping[str, Interval] = field(default_factory=lambda: dict(SCENARIO_BOUNDS))
    clip: bool = False

    def __post_init__(self) -> None:
        checked = {name: check_interval(name, pair) for name, pair in self.bounds.items()}
        object.__setattr__(self, "bounds", checked)

    def __hash__(self) -> int:
        return hash((frozenset(self.bounds.items()), self.clip))


Means: TypeAlias = tuple[FloatArray, ...]
"""What the conjunction of several values depends on, each [steps, n].

The least value; the sum of min(value, 0); the sum of log(1 + value), which only counts
(and may be NaN otherwise) where no value is negative. Sums of one sign only, so that no
digits cancel.
"""


def clipping_flips(predicate: Predicate, low: float, high: float) -> InputError:
    """The error of bounds within which a predicate cannot change sign."""
    return InputError(
        f"agm: clipping to the bounds would change whether '{shorten(predicate)}' holds, whose"
        f" margin has the range [{low:g}, {high:g}]; declare wider bounds"
    )


class AgmSemantics(NumberSemantics):
    """Agm robustness of every operator."""

    def __init__(self, metric: Agm) -> None:
        self.metric = metric
        self._ranges: dict[Predicate, Interval] = {}

    def _range(self, predicate: Predicate) -> Interval:
        if predicate not in self._ranges:
            self._ranges[predicate] = margin_range(predicate, self.metric.bounds)
        return self._ranges[predicate]

    def opposite(self) -> AgmSemantics:
        return self

    def truth(self, like: FloatArray, steps: int) -> FloatArray:
        return self.constant(1.0, like, steps)

    def scale(self, predicate: Predicate) -> float | None:
        """What margins are multiplied by; ``None`` where no signal has a say.

        Raises:
            InputError: The declared bounds give the predicate no range.
        """
        low, high = self._range(predicate)
        return None if low == high else 1.0 / (high - low)

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:
        scale = self.scale(predicate)
        if scale is None:  # as true and false
            return np.sign(margin)
        if self.metric.clip:
            margin = _clip(predicate, margin, *self._range(predicate))
        margin *= scale
        return margin

    def negate(self, value: FloatArray) -> FloatArray:
        return -value

    def conjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        means = reduce(_join, [_means(value) for value in values])
        return _conclude(means, len(values))

    def disjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        means = reduce(_join, [_means(-value) for value in values])
        return -_conclude(means, len(values))

    def always(self, value: FloatArray, width: int) -> FloatArray:
        return _over_windows(value, width)

    def always_predicate(self, predicate: Predicate, margin: FloatArray, width: int) -> FloatArray:
        return self.always(self.predicate(predicate, margin), width)

    def eventually(self, value: FloatArray, width: int) -> FloatArray:
        return -_over_windows(-value, width)

    def until(self, left: FloatArray, right: FloatArray, first: int, last: int) -> FloatArray:
        steps, width = len(left) - last, last - first + 1
        if steps == 1:
            met = self.conjunction([right, _conjunctions_so_far(left)[first:]])
            return self.eventually(met, width)
        sums = tuple(np.zeros((steps, left.shape[1])) for _ in range(2))
        held, failed = (
            (np.full_like(sums[0], math.inf), *sums),
            (np.full_like(sums[0], math.inf), *sums),
        )
        for offset in range(last + 1):
            held = _join(held, _means(left[offset : offset + steps]))
            if offset >= first:
                so_far = _conclude(held, offset + 1)
                target = right[offset - first : offset - first + steps]
                failed = _join(failed, _means(-self.conjunction([target, so_far])))
        return -_conclude(failed, width)


def _clip(predicate: Predicate, margin: FloatArray, low: float, high: float) -> FloatArray:
    clipped = np.clip(margin, low, high)
    if (np.sign(clipped) != np.sign(margin)).any():
        raise clipping_flips(predicate, low, high)
    return clipped


def _means(values: FloatArray) -> Means:
    return values, np.minimum(values, 0.0), np.log1p(values)


def _join(earlier: Means, later: Means) -> Means:
    return np.minimum(earlier[0], later[0]), earlier[1] + later[1], earlier[2] + later[2]


def _conclude(means: Means, count: int | FloatArray) -> FloatArray:
    """The conjunction of ``count`` values."""
    least, failing, growth = means
    return np.where(least <= 0.0, failing / count, np.expm1(growth / count))


def _over_windows(values: FloatArray, width: int) -> FloatArray:
    """Conjunction over every window of ``width`` steps, [s, n] -> [s - width + 1, n]."""
    if len(values) > width:
        return _conclude(sliding(_join, _means(values), width), width)
    least = values.min(axis=0, keepdims=True)
    failing = fold(np.add, np.minimum(values, 0.0))
    growth = fold(np.add, np.log1p(_compound(values)))
    return _conclude((least, failing, growth), width)


def _conjunctions_so_far(values: FloatArray) -> FloatArray:
    """Conjunction of the steps up to each, [T, n]."""
    least, failing, growth = _means(values)
    means = running(np.minimum, least), running(np.add, failing), running(np.add, growth)
    counts = np.arange(1.0, len(values) + 1.0)[:, None]
    return _conclude(means, counts)


HALVINGS = 4
"""Before logarithms are taken, so that one serves up to 16 steps."""


def _compound(values: FloatArray) -> FloatArray:
    """prod(1 + value) - 1 over groups of steps, [s, n] -> [groups, n], in place.

    To full accuracy where all values are positive. The steps are folded as by `fold`.
    """
    for _ in range(HALVINGS):
        if len(values) > 1:
            half = half_of(len(values))
            _compound_pair(values[: len(values) - half], values[half:])
            values = values[:half]
    return values


def _compound_pair(left: FloatArray, right: FloatArray) -> None:
    """Into ``left``."""
    product = left * right
    left += product
    left += right
