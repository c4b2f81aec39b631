"""Folds over a rollout's steps as plain loops, compiled where numba is there.

Each reads rows ``values [n, T]`` of a signal, and folds its distances ``(value - offset) * factor``
from a threshold over the steps from ``start`` to before ``stop``. The same arithmetic in the same
order as :mod:`pemviz.stl.agm` and :mod:`pemviz.stl.dominant`, so that both give the same numbers to
the last bit. Steps are taken eight at a time, :mod:`pemviz.lanes`. Imported when it is time to
compile: see :mod:`pemviz.stl.compiled`.
"""

import importlib
import math
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.compiling import inlined, translated, with_numba
from pemviz.lanes import (
    LANES,
    filled,
    larger,
    least_of,
    loaded,
    memory,
    most_of,
    pack,
    smaller,
    store,
    sum_of,
    turn,
)
from pemviz.stl.tasks import WHOLE, Means, Near, Packing, Rows, Seen, Task

WIDE = with_numba(lambda _: importlib.import_module("pemviz.wide_lanes"))
"""Having taught numba what lanes are; ``None`` without numba."""
USED_AS_OF = "c0706ec740ae3a51"
"""Of the files of lanes and tasks: what numba keeps of this one is made anew when they change."""
CERTAIN = 1e-17
"""1 plus this is 1."""


@inlined
def _rows(task: Task) -> Rows:
    states, width = task.values.shape[1], task.stop - task.start
    return Rows(memory(task.values), states, task.start, width, task.offset, task.factor)


@inlined
def _nothing() -> Seen:
    return Seen(filled(math.inf), filled(-math.inf), filled(0.0))


@inlined
def _with(seen: Seen, eight: Any) -> Seen:
    least, most = smaller(seen.least, eight), larger(seen.most, eight)
    return Seen(least, most, seen.wrong + (eight - eight))


@inlined
def _with_all(seen: Seen, values: Any, begin: Any, count: Any) -> Seen:
    """With ``count`` values from ``values[begin]`` on; some may be seen twice."""
    for t in range(0, count - LANES + 1, LANES):
        seen = _with(seen, loaded(values, begin + t))
    if count < LANES:
        for t in range(count):
            seen = _with(seen, filled(values[begin + t]))
    elif count % LANES:
        seen = _with(seen, loaded(values, begin + count - LANES))
    return seen


@inlined
def _row(rows: Rows, i: int, seen: Seen) -> tuple[Seen, Seen]:
    """What is seen of row i at the steps; and of all that was seen before and all T of it."""
    begin, stop = i * rows.states, rows.start + rows.width
    row = _with_all(_nothing(), rows.values, begin + rows.start, rows.width)
    least, most = smaller(seen.least, row.least), larger(seen.most, row.most)
    seen = Seen(least, most, seen.wrong + row.wrong)
    if rows.width < rows.states:
        seen = _with_all(seen, rows.values, begin, rows.start)
        seen = _with_all(seen, rows.values, begin + stop, rows.states - stop)
    return row, seen


@inlined
def _allowed(seen: Seen, low: float, high: float) -> bool:
    inside = least_of(seen.least) >= low and most_of(seen.most) <= high
    return inside and sum_of(seen.wrong) == 0.0


@translated
def all_extremes(task: Task, least: FloatArray, most: FloatArray) -> bool:
    """The extremes of each row at the steps, to ``[n]``; whether all rows' values are allowed."""
    rows, seen = _rows(task), _nothing()
    for i in range(least.size):
        row, seen = _row(rows, i, seen)
        least[i], most[i] = least_of(row.least), most_of(row.most)
    return _allowed(seen, task.low, task.high)


@inlined
def _least_distance(rows: Rows, row: Seen) -> Any:
    value = least_of(row.least) if rows.factor > 0.0 else most_of(row.most)
    return (value - rows.offset) * rows.factor


@inlined
def _distances(rows: Rows, i: int, part: Any) -> None:
    """Of row i, written to ``part``."""
    begin, last = i * rows.states + rows.start, rows.width - LANES
    if rows.width < LANES:
        for t in range(rows.width):
            part[t] = (rows.values[begin + t] - rows.offset) * rows.factor
        return
    offset, factor = filled(rows.offset), filled(rows.factor)
    store((loaded(rows.values, begin + last) - offset) * factor, part, last)
    for t in range(0, last, LANES):
        store((loaded(rows.values, begin + t) - offset) * factor, part, t)


@inlined
def _negative(part: Any, t: int) -> Any:
    """Eight sums of two numbers below 0 of `WHOLE`, half of them apart."""
    zero = filled(0.0)
    return smaller(loaded(part, t), zero) + smaller(loaded(part, t + WHOLE // 2), zero)


@inlined
def _sum_of_negative(part: Any, size: int) -> Any:
    """The sum of min(number, 0) over ``part``, half upon half; it is overwritten."""
    while size > WHOLE:
        size //= 2
        for t in range(0, size, LANES):
            one, other = loaded(part, t), loaded(part, size + t)
            store(smaller(one, filled(0.0)) + smaller(other, filled(0.0)), part, t)
    even = _negative(part, 0) + _negative(part, 32)
    even = even + (_negative(part, 16) + _negative(part, 48))
    odd = _negative(part, 8) + _negative(part, 40)
    odd = odd + (_negative(part, 24) + _negative(part, 56))
    return sum_of(even + odd)


@inlined
def _joined(left: Any, right: Any) -> Any:
    return left + left * right + right


@inlined
def _pair(part: Any, t: int) -> Any:
    """Eight pairs joined of `WHOLE` numbers, half of them apart."""
    return _joined(loaded(part, t), loaded(part, t + WHOLE // 2))


@inlined
def _compound(part: Any, size: int, groups: int) -> None:
    """prod(1 + number) - 1 of each of ``groups`` groups of ``part``, into its first places."""
    if groups > LANES:
        while size > groups:
            size //= 2
            for t in range(0, size, LANES):
                store(_joined(loaded(part, t), loaded(part, size + t)), part, t)
        return
    even = _joined(_pair(part, 0), _pair(part, 32))
    even = _joined(even, _joined(_pair(part, 16), _pair(part, 48)))
    odd = _joined(_pair(part, 8), _pair(part, 40))
    odd = _joined(odd, _joined(_pair(part, 24), _pair(part, 56)))
    store(_joined(even, odd), part, 0)
    size = LANES
    while size > groups:
        size //= 2
        for t in range(size):
            part[t] = _joined(part[t], part[size + t])


@translated
def mean_parts(task: Task, means: Means) -> bool:
    """Of each row its `Means`; whether all rows' values are allowed."""
    rows, seen, part = _rows(task), _nothing(), memory(means.part)
    size, groups = means.part.size, means.growth.shape[0]
    for i in range(means.fails.size):
        row, seen = _row(rows, i, seen)
        least = _least_distance(rows, row)
        fails = least <= 0.0
        means.fails[i] = fails
        _distances(rows, i, part)  # beyond the steps 0 stays, which changes neither fold
        if fails:
            means.failing[i] = _sum_of_negative(part, size)
        else:
            _compound(part, size, groups)
            for t in range(groups):
                means.growth[t, i] = part[t]
    return _allowed(seen, task.low, task.high)


@translated
def exponents_near(task: Task, near: Near, first: int) -> tuple[int, bool]:
    """``(distance - base) * -beta`` at each step that counts, of rows from ``first`` on.

    Returns:
        The row after the last that found room for all that it might have; whether all those rows'
        values are allowed.
    """
    rows, seen, count, last = _rows(task), _nothing(), 0, first
    packing = Packing(-near.beta, near.reach, near.largest, memory(near.exponents))
    uncounted, room = _uncounted(rows.width), near.exponents.size - rows.width - LANES
    near.ends[first] = 0
    while last < near.base.size and count <= room:
        row, seen = _row(rows, last, seen)
        least = _least_distance(rows, row)
        base = max(least, 0.0) if near.positive else min(least, 0.0)
        count = _packed(rows, last, packing, base, uncounted, count)
        near.base[last], near.ends[last + 1] = base, count
        last += 1
    return last, _allowed(seen, task.low, task.high)


@inlined
def _uncounted(width: int) -> Any:
    """Infinity for those of the last eight steps that stand in whole eights before them, else 0.

    Of fewer than eight steps each is taken eight times, and counts once.
    """
    steps = np.zeros(2 * LANES)
    if width < LANES:
        steps[1:LANES] = math.inf
        return loaded(steps, 0)
    steps[:LANES] = math.inf
    return loaded(steps, width % LANES)


@inlined
def _packed(  # noqa: PLR0917  (inlined, where keywords are not known)
    rows: Rows, i: int, packing: Packing, base: Any, uncounted: Any, count: Any
) -> Any:
    """Write the exponents of row i's steps that count; the place after the last one."""
    values, width, begin = rows.values, rows.width, i * rows.states + rows.start
    for t in range(0, width - LANES + 1, LANES):
        eight = loaded(values, begin + t)
        count = _packed_eight(rows, packing, base, eight, filled(-0.0), count)
    if width < LANES:
        for t in range(width):
            eight = filled(values[begin + t])
            count = _packed_eight(rows, packing, base, eight, uncounted, count)
    elif width % LANES:
        eight = loaded(values, begin + width - LANES)
        count = _packed_eight(rows, packing, base, eight, uncounted, count)
    return count


@inlined
def _packed_eight(  # noqa: PLR0917  (as above)
    rows: Rows, packing: Packing, base: Any, eight: Any, uncounted: Any, count: Any
) -> Any:
    """The same of eight steps, to whose distances ``uncounted`` is added."""
    distance = (eight - filled(rows.offset)) * filled(rows.factor)
    exponent = smaller((distance - filled(base)) * filled(packing.rate), filled(packing.largest))
    edge = filled(base + packing.reach)
    return pack(exponent, distance + uncounted, edge, packing.exponents, count)


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


@translated
def turned(columns: FloatArray, first: int, rows: FloatArray) -> None:
    """Copy rollouts from ``first`` on.

    Args:
        columns: ``[T, N]``, T at least 8.
        first: Of the rollouts.
        rows: ``[n, T]``, written to; n at least 8, ``first + n`` at most N.
    """
    (states, rollouts), count = columns.shape, rows.shape[0]
    source, target = memory(columns), memory(rows)
    for i in range(0, count, LANES):
        row = min(i, count - LANES)
        for t in range(0, states, LANES):
            step = min(t, states - LANES)
            place = step * rollouts + first + row
            turn(source, place, rollouts, target, row * states + step, states)
