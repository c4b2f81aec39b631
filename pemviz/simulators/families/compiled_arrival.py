"""The state that a step leads to, by the compiled loops; the same as ``arrival.py`` gives."""

from collections.abc import Mapping

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.simulators.families import loops
from pemviz.simulators.families.arrival import Left
from pemviz.simulators.families.cars import headings_of, lateral_places
from pemviz.simulators.families.kernels import FamilyLoops
from pemviz.simulators.families.margins import SEEN_S
from pemviz.simulators.families.names import OF_EACH, Each, by_car


def arrive(compiled: FamilyLoops, left: Left) -> tuple[Mapping[str, FloatArray], IntArray, Each]:
    """Signals of the next states, states ahead ``[K, N]``, and where the other cars are.

    Args:
        compiled: The loops.
        left: The states that the step leaves.
    """
    config, numbers = left.config, loops.numbers_of(left.config)
    dt_s, time_s = config.dt_s, float(left.states.step + 1) * config.dt_s
    before, after = _before(left), _empty(*left.each.gap_m.shape)
    done = _done(left, lateral_places(config, left.values, time_s=time_s + dt_s))
    compiled.move(numbers, before, done, after)
    struck = np.flatnonzero(after.struck)
    if struck.size:
        after.own[loops.IMPACT, struck] = np.hypot(*after.struck_m[:, struck]) / dt_s
    heading_rad = headings_of(after.sine, after.speed_mps, left.each.heading_rad)
    along_mps = after.speed_mps * np.cos(heading_rad)
    seen_from_s = left.values.get("cut_in_time", left.values["ego_speed"]) + SEEN_S
    compiled.judge(numbers, before, after, loops.Turned(along_mps, seen_from_s, time_s))
    each = Each(after.gap_m, after.aside_m, after.speed_mps, heading_rad)
    signals: dict[str, FloatArray] = dict(zip(loops.OWN, after.own, strict=True))
    for what, values in zip(OF_EACH, each, strict=True):
        signals |= by_car(what, left.cars, values)
    return signals, after.states_ahead, each


def _before(left: Left) -> loops.Before:
    signals, each = left.states.signals, left.each
    none = signals[loops.OWN[loops.HAD]]  # signals that the family does not have
    return loops.Before(
        gap_m=each.gap_m,
        aside_m=each.aside_m,
        speed_mps=each.speed_mps,
        along_mps=left.along_mps,
        sine=np.sin(each.heading_rad),
        states_ahead=left.states_ahead,
        own=np.stack([signals.get(name, none) for name in loops.OWN]),
    )


def _done(left: Left, next_m: FloatArray) -> loops.Done:
    told = left.told
    return loops.Done(
        there=np.ascontiguousarray(told.there),
        gap_m=np.ascontiguousarray(told.gap_m),
        aside_m=np.ascontiguousarray(told.aside_m),
        closing_mps=np.ascontiguousarray(told.closing_mps),
        set_mps=np.array(left.values["ego_speed"], dtype=np.float64),
        others_mps2=left.others_mps2,
        next_m=next_m,
    )


def _empty(cars: int, count: int) -> loops.After:
    each = np.empty((4, cars, count))
    return loops.After(
        *each,
        states_ahead=np.empty((cars, count), dtype=np.int64),
        own=np.empty((len(loops.OWN), count)),
        struck=np.empty(count, dtype=np.bool_),
        struck_m=np.empty((2, count)),
    )
