"""Folds over a rollout's steps as plain loops, compiled where numba is there.

Each reads rows ``values [n, T]`` of a signal, and folds its distances ``(value - offset) * factor``
from a threshold over the steps from ``start`` to before ``stop``. The same arithmetic in the same
order as :mod:`pemviz.stl.agm` and :mod:`pemviz.stl.dominant`, so that both give the same numbers to
the last bit. Slices of a row, not sums of indices, are what lets a compiler see that steps are
neighbours; where it does not see it, steps are taken eight at a time, :mod:`pemviz.stl.lanes`.
Imported when it is time to compile: see :mod:`pemviz.stl.compiled`.
"""

import importlib
from typing import Any, NamedTuple

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.compiling import inlined, translated, with_numba
from pemviz.stl.lanes import LANES, filled, loaded, pack, smaller, store

WIDE = with_numba(lambda _: importlib.import_module("pemviz.stl.wide_lanes"))
"""Having taught numba what lanes are; ``None`` without numba."""
LANES_AS_OF = "0bab148e30f4f280"
"""Of their files, so that what numba keeps of this one is made anew when they change."""
MAGNITUDE = 0x7FFF_FFFF_FFFF_FFFF
"""All bits of a double but its sign."""
CERTAIN = 1e-17
"""1 plus this is 1."""


class Task(NamedTuple):
    """What is folded.

    Attributes:
        values: ``[n, T]``, rows in one piece.
        bits: The same memory as whole numbers.
        start: First step.
        stop: The step after the last.
        offset: Of the signal.
        factor: Of its distance from there; negative where it is to be small.
        low: Least value that is allowed at any of the T steps, as `ordered` has it.
        high: Largest.
    """

    values: FloatArray
    bits: IntArray
    start: int
    stop: int
    offset: float
    factor: float
    low: int
    high: int


def task_of(
    values: FloatArray,
    window: tuple[int, int],
    offset: float,
    factor: float,
    allowed: tuple[float, float],
) -> Task:
    """The task whose steps are from the first of ``window`` to before its second.

    Args:
        values: ``[n, T]``, rows in one piece.
        window: Steps.
        offset: Of the signal.
        factor: Of its distance from there.
        allowed: Least and largest value.
    """
    low, high = allowed[0] or -0.0, allowed[1] or 0.0  # both zeros lie within a bound of zero
    keys = np.array([low, high]).view(np.int64)
    keys = keys ^ ((keys >> 63) & MAGNITUDE)
    return Task(values, values.view(np.int64), *window, offset, factor, int(keys[0]), int(keys[1]))


@inlined
def ordered(bits: Any) -> Any:
    """Whole numbers in the order of doubles, from these doubles' bits; and back again.

    Unlike doubles their least does not depend on who is asked first, so that many are compared at
    once. A NaN comes before all numbers or after them, by its sign.
    """
    return bits ^ ((bits >> 63) & MAGNITUDE)


@inlined
def _extremes(bits: IntArray) -> tuple[Any, Any]:
    least, most = MAGNITUDE, -MAGNITUDE - 1
    for t in range(bits.size):
        key = ordered(bits[t])
        least, most = min(least, key), max(most, key)
    return least, most


@inlined
def extremes(task: Task, i: int) -> tuple[Any, Any, bool]:
    """`ordered`, the least and largest value of row i at the steps; whether all T are allowed."""
    row = task.bits[i]
    least, most = _extremes(row[task.start : task.stop])
    before_least, before_most = _extremes(row[: task.start])
    after_least, after_most = _extremes(row[task.stop :])
    allowed = min(least, before_least, after_least) >= task.low
    return least, most, allowed & (max(most, before_most, after_most) <= task.high)


@translated
def all_extremes(task: Task, least: IntArray, most: IntArray) -> bool:
    """`extremes` of each row, written to ``[n]``; whether all rows' values are allowed."""
    good = True
    for i in range(least.size):
        least[i], most[i], allowed = extremes(task, i)
        good &= allowed
    return good


@inlined
def _least_distance(task: Task, least: int, most: int) -> Any:
    """That of a row with these `extremes`."""
    value = np.int64(ordered(least if task.factor > 0.0 else most)).view(np.float64)
    return (value - task.offset) * task.factor


@inlined
def _aligned(size: int) -> FloatArray:
    """Zeros that begin where eight of them lie in one line of the cache."""
    zeros = np.zeros(size + LANES)
    first = -(zeros.ctypes.data // 8) % LANES
    return zeros[first : first + size]


@inlined
def _distances(task: Task, flat: FloatArray, begin: Any, part: FloatArray) -> None:
    """Of a row whose steps begin at ``flat[begin]``, written to ``part``."""
    offset, factor, width = filled(task.offset), filled(task.factor), task.stop - task.start
    whole = width - width % LANES
    for t in range(whole, width):
        part[t] = (flat[begin + t] - task.offset) * task.factor
    for t in range(0, whole, LANES):
        store((loaded(flat, begin + t) - offset) * factor, part, t)


@inlined
def _sum_of_negative(part: FloatArray) -> Any:
    """The sum of min(number, 0) over ``part``, which is overwritten."""
    zero, size = filled(0.0), part.size
    for t in range(0, size, LANES):
        store(smaller(loaded(part, t), zero), part, t)
    while size >= 4 * LANES:  # two halvings at once
        size //= 4
        for t in range(0, size, LANES):
            even = loaded(part, t) + loaded(part, 2 * size + t)
            odd = loaded(part, size + t) + loaded(part, 3 * size + t)
            store(even + odd, part, t)
    if size > LANES:
        store(loaded(part, 0) + loaded(part, LANES), part, 0)
    even = (part[0] + part[4]) + (part[2] + part[6])
    return even + ((part[1] + part[5]) + (part[3] + part[7]))


@inlined
def _joined(left: Any, right: Any) -> Any:
    return left + left * right + right


@inlined
def _compound(part: FloatArray, groups: int) -> None:
    """prod(1 + number) - 1 of each of ``groups`` groups of ``part``, into its first places."""
    size, least = part.size, max(groups, LANES)
    while size >= 4 * least:  # two halvings at once
        size //= 4
        for t in range(0, size, LANES):
            even = _joined(loaded(part, t), loaded(part, 2 * size + t))
            odd = _joined(loaded(part, size + t), loaded(part, 3 * size + t))
            store(_joined(even, odd), part, t)
    if size > least:
        size //= 2
        for t in range(0, size, LANES):
            store(_joined(loaded(part, t), loaded(part, size + t)), part, t)
    while size > groups:
        size //= 2
        for t in range(size):
            part[t] = _joined(part[t], part[size + t])


@translated
def mean_parts(task: Task, ties: bool, fails: Any, failing: FloatArray, growth: FloatArray) -> bool:
    """What agm's conjunction of all steps rests on; whether all rows' values are allowed.

    Args:
        task: What is folded.
        ties: Whether a distance of 0 fails.
        fails: ``[n]``, written to: whether a step fails.
        failing: ``[n]``: where one does, the sum of min(distance, 0).
        growth: ``[groups, n]``: where none does, prod(1 + distance) - 1 of each group.
    """
    width, size, good = task.stop - task.start, LANES, True
    while size < width:
        size *= 2
    flat = task.values.reshape(-1)
    part = _aligned(size)  # what is beyond the steps stays 0, which changes neither fold
    for i in range(fails.size):
        low, high, allowed = extremes(task, i)
        least = _least_distance(task, low, high)
        good &= allowed
        fails[i] = least < 0.0 or (ties and least == 0.0)
        _distances(task, flat, i * task.values.shape[1] + task.start, part)
        if fails[i]:
            failing[i] = _sum_of_negative(part)
        else:
            _compound(part, growth.shape[0])
            for t in range(growth.shape[0]):
                growth[t, i] = part[t]
    return good


class Near(NamedTuple):
    """Which steps count in a soft minimum; see `pemviz.stl.dominant.DominantSteps`.

    Attributes:
        beta: Sharpness.
        positive: Which part.
        reach: A step counts whose distance is at most this above the row's base.
        largest: Exponent; above it stands this one.
        base: ``[n]``, written to.
        ends: ``[n + 1]``: row i's exponents stand from ``ends[i]`` to ``ends[i + 1]``.
        exponents: Written to, all rows' one after another.
    """

    beta: float
    positive: bool
    reach: float
    largest: float
    base: FloatArray
    ends: IntArray
    exponents: FloatArray


@translated
def exponents_near(task: Task, near: Near, first: int) -> tuple[int, bool]:
    """``(distance - base) * -beta`` at each step that counts, of rows from ``first`` on.

    Returns:
        The row after the last that found room for all that it might have; whether all those rows'
        values are allowed.
    """
    width, count, good = task.stop - task.start, 0, True
    near.ends[first] = 0
    for i in range(first, near.base.size):
        if count + width + LANES > near.exponents.size:
            return i, good
        low, high, allowed = extremes(task, i)
        least = _least_distance(task, low, high)
        good &= allowed
        base = max(least, 0.0) if near.positive else min(least, 0.0)
        near.base[i] = base
        count = _packed(task.values[i][task.start : task.stop], task, near, base, count)
        near.ends[i + 1] = count
    return near.base.size, good


@inlined
def _packed(row: FloatArray, task: Task, near: Near, base: Any, count: Any) -> Any:
    """Write the exponents of one row from place ``count`` on; the place after the last."""
    offset, factor, edge = filled(task.offset), filled(task.factor), filled(base + near.reach)
    bases, rate, largest = filled(base), filled(-near.beta), filled(near.largest)
    whole = row.size - row.size % LANES
    for t in range(0, whole, LANES):
        distance = (loaded(row, t) - offset) * factor
        exponent = smaller((distance - bases) * rate, largest)
        count = pack(exponent, distance, edge, near.exponents, count)
    for t in range(whole, row.size):
        one = (row[t] - task.offset) * task.factor
        near.exponents[count] = min((one - base) * -near.beta, near.largest)
        count += int(one <= base + near.reach)
    return count


@translated
def add_powers(
    ends: IntArray, powers: FloatArray, shift: FloatArray, totals: FloatArray, positive: bool
) -> None:
    """Sums of powers, or in the positive part of ``power / (1 + power * shift)``.

    Args:
        ends: ``[n + 1]``, as in `Near`.
        powers: Exponentials of the exponents there.
        shift: ``[n]``.
        totals: ``[n]``, to which they are added.
        positive: Which part.
    """
    for i in range(totals.size):
        total, scale = 0.0, shift[i]
        if not positive or scale < CERTAIN:  # where no power is above 1: the divisor is 1
            for k in range(ends[i], ends[i + 1]):
                total += powers[k]
        else:
            for k in range(ends[i], ends[i + 1]):
                total += powers[k] / (1.0 + powers[k] * scale)
        totals[i] += total
