"""A step of encounters, rollout by rollout, as numba compiles it.

What numpy computes with whole arrays stands in the modules beside, with the reasons; here it is the
same operations in the same order, so that all numbers are the same to the last bit, but for the
sign of a zero. Functions of which numpy has its own versions (sine, arcsine and the like) stay with
numpy, between the loops. Arrays have a row for each car, ``[K, N]``.
"""

from typing import NamedTuple

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.config import EncounterConfig
from pemviz.simulators.families import margins, sight
from pemviz.simulators.families.cars import LARGEST_SINE
from pemviz.simulators.families.names import (
    AVOIDABLE_BY,
    CLEARANCE,
    COLLIDED,
    EGO_ACCELERATION,
    EGO_SPEED,
    EGO_X,
    IMPACT_SPEED,
    NEEDLESS,
    SAFE_DISTANCE,
)

OWN = (
    EGO_X, EGO_SPEED, EGO_ACCELERATION, CLEARANCE, SAFE_DISTANCE, NEEDLESS, AVOIDABLE_BY, COLLIDED,
    IMPACT_SPEED,
)  # fmt: skip
"""Signals that are about no single other car, in the order of their rows."""
X, V, A, CLEAR, SAFE, NEED, AVOID, HAD, IMPACT = range(len(OWN))


class EncounterNumbers(NamedTuple):
    """What of an encounter the loops need.

    Constants of the modules beside are among it: a compiled loop that is kept on disk would not
    notice that one has changed.
    """

    dt_s: float
    length_m: float
    width_m: float
    height_m: float
    lane_reach_m: float
    path_reach_m: float
    in_lane_m: float
    speed_gain_per_s: float
    gap_gain_per_s2: float
    closing_gain_per_s: float
    standstill_gap_m: float
    time_gap_s: float
    maximum_deceleration_mps2: float
    maximum_acceleration_mps2: float
    hard_deceleration_mps2: float
    hard_reserve_s: float
    reaction_time_s: float
    recovery_steps: int
    gap_bound_m: float
    camera_to_bumper_m: float
    camera_height_m: float
    farthest_m: float
    edge: float
    cuts_in: bool
    largest_sine: float
    unavoidable_s: float
    assumed_mps2: float
    assumed_delay_s: float
    nearest_m: float
    partly: float
    largely: float
    hidden: float
    car_class: float
    away_rad: float


def numbers_of(config: EncounterConfig) -> EncounterNumbers:
    """Those of an encounter."""
    return EncounterNumbers(
        dt_s=config.dt_s,
        length_m=config.car_length_m,
        width_m=config.car_width_m,
        height_m=config.car_height_m,
        lane_reach_m=(config.lane_width_m + config.car_width_m) / 2,
        path_reach_m=config.path_half_width_m + config.car_width_m / 2,
        in_lane_m=config.lane_width_m / 2 - margins.INTRUSION_M,
        speed_gain_per_s=config.speed_gain_per_s,
        gap_gain_per_s2=config.gap_gain_per_s2,
        closing_gain_per_s=config.closing_gain_per_s,
        standstill_gap_m=config.standstill_gap_m,
        time_gap_s=config.time_gap_s,
        maximum_deceleration_mps2=config.maximum_deceleration_mps2,
        maximum_acceleration_mps2=config.maximum_acceleration_mps2,
        hard_deceleration_mps2=config.hard_deceleration_mps2,
        hard_reserve_s=config.hard_reserve_s,
        reaction_time_s=config.reaction_time_s,
        recovery_steps=margins.recovery_steps(config),
        gap_bound_m=config.gap_bound_m,
        camera_to_bumper_m=config.camera_to_bumper_m,
        camera_height_m=config.camera_height_m,
        farthest_m=config.farthest_m,
        edge=sight.image_edge(config),
        cuts_in=config.family == "cut-in",
        largest_sine=LARGEST_SINE,
        unavoidable_s=margins.UNAVOIDABLE_S,
        assumed_mps2=margins.ASSUMED_DECELERATION_MPS2,
        assumed_delay_s=margins.ASSUMED_DELAY_S,
        nearest_m=sight.NEAREST_M,
        partly=sight.PARTLY,
        largely=sight.LARGELY,
        hidden=sight.HIDDEN,
        car_class=sight.CAR_CLASS,
        away_rad=sight.HEADING_AWAY_RAD,
    )


class Before(NamedTuple):
    """The states that a step leaves.

    Attributes:
        gap_m: Of the K other cars, ``[K, N]``, as are the next five.
        aside_m: Likewise.
        speed_mps: Likewise.
        along_mps: Speeds along the road.
        sine: Of headings.
        states_ahead: For how many states each is the nearest ahead in lane.
        own: Signals :data:`OWN`, ``[9, N]``.
    """

    gap_m: FloatArray
    aside_m: FloatArray
    speed_mps: FloatArray
    along_mps: FloatArray
    sine: FloatArray
    states_ahead: IntArray
    own: FloatArray


class Done(NamedTuple):
    """What is done in a step.

    Attributes:
        there: Which slots the ego is told of, ``[S, N]``, as are the next three.
        gap_m: What it is told of them.
        aside_m: Likewise.
        closing_mps: Likewise.
        set_mps: Its set speed, ``[N]``.
        others_mps2: How hard other cars brake, ``[K, N]``.
        next_m: Where their profile has them a step after this one, ``[K, N]``.
    """

    there: BoolArray
    gap_m: FloatArray
    aside_m: FloatArray
    closing_mps: FloatArray
    set_mps: FloatArray
    others_mps2: FloatArray
    next_m: FloatArray


class After(NamedTuple):
    """The next states, written to.

    Attributes:
        gap_m: ``[K, N]``, as are the next four.
        aside_m: Likewise.
        speed_mps: Likewise.
        sine: Of the headings that the profile asks for.
        states_ahead: As before.
        own: Signals :data:`OWN`, ``[9, N]``.
        struck: Where the ego touches a car in this step, ``[N]``.
        struck_m: How far that one has moved against the ego there, along and across, ``[2, N]``.
    """

    gap_m: FloatArray
    aside_m: FloatArray
    speed_mps: FloatArray
    sine: FloatArray
    states_ahead: IntArray
    own: FloatArray
    struck: BoolArray
    struck_m: FloatArray


class Turned(NamedTuple):
    """What is known of the next states besides.

    Attributes:
        along_mps: The other cars' speeds along the road, ``[K, N]``.
        seen_from_s: From when on a car that cuts in has moved sideways for long enough, ``[N]``.
        time_s: The states'.
    """

    along_mps: FloatArray
    seen_from_s: FloatArray
    time_s: float


def move(numbers: EncounterNumbers, before: Before, done: Done, after: After) -> None:
    """Everything of the next states but headings and what follows from them."""
    drive(numbers, before, done, after)
    carry(numbers, before, done, after)
    stop(numbers, before, done, after)
    reason(numbers, before, done, after)


def drive(numbers: EncounterNumbers, before: Before, done: Done, after: After) -> None:
    """The ego's acceleration, as in ``ego.py``."""
    for n in range(before.own.shape[1]):
        if before.own[HAD, n] > 0.0:
            after.own[A, n] = 0.0
            continue
        ego_mps, hard = before.own[V, n], False
        kept_m = numbers.standstill_gap_m + numbers.time_gap_s * ego_mps
        wanted = numbers.speed_gain_per_s * (done.set_mps[n] - ego_mps)
        for slot in range(done.there.shape[0]):
            gap_m, closing_mps = done.gap_m[slot, n], done.closing_mps[slot, n]
            beside = abs(done.aside_m[slot, n]) < numbers.path_reach_m
            if done.there[slot, n] and beside and gap_m + numbers.length_m > 0.0:
                follow = (
                    numbers.gap_gain_per_s2 * (gap_m - kept_m)
                    - numbers.closing_gain_per_s * closing_mps
                )
                wanted = min(wanted, follow)
                needed_s = (
                    closing_mps / (2.0 * numbers.hard_deceleration_mps2) + numbers.hard_reserve_s
                )
                hard = hard or (closing_mps > 0.0 and gap_m < closing_mps * needed_s)
        wanted = max(wanted, -numbers.maximum_deceleration_mps2)
        wanted = min(wanted, numbers.maximum_acceleration_mps2)
        braked = -numbers.hard_deceleration_mps2 if hard else wanted
        after.own[A, n] = max(braked, -ego_mps / numbers.dt_s)


def carry(numbers: EncounterNumbers, before: Before, done: Done, after: After) -> None:
    """Move all cars for a whole step; gaps are places along the road, for now."""
    dt_s = numbers.dt_s
    for n in range(before.own.shape[1]):
        ego_x_m, ego_mps = before.own[X, n], before.own[V, n]
        after.own[X, n] = ego_x_m + ego_mps * dt_s
        after.own[V, n] = max(ego_mps + after.own[A, n] * dt_s, 0.0)
        for car in range(before.gap_m.shape[0]):
            speed_mps = before.speed_mps[car, n]
            x_m = ego_x_m + before.gap_m[car, n] + numbers.length_m
            after.gap_m[car, n] = x_m + before.along_mps[car, n] * dt_s
            sideways_m = speed_mps * before.sine[car, n] * dt_s
            after.aside_m[car, n] = before.aside_m[car, n] + sideways_m
            after.speed_mps[car, n] = max(speed_mps - done.others_mps2[car, n] * dt_s, 0.0)


def stop(numbers: EncounterNumbers, before: Before, done: Done, after: After) -> None:
    """Put the ego and the car that it touches first where they touch, as in ``arrival.py``."""
    length_m = numbers.length_m
    for n in range(before.own.shape[1]):
        ego_x_m, next_x_m = before.own[X, n], after.own[X, n]
        first, least = 0, np.inf
        for car in range(before.gap_m.shape[0]):
            begin_m, later_m = before.gap_m[car, n] + length_m, after.gap_m[car, n] - next_x_m
            share = touch(numbers, begin_m, before.aside_m[car, n], later_m, after.aside_m[car, n])
            if share < least:
                first, least = car, share
        had = before.own[HAD, n] > 0.0
        struck = not had and least <= 1.0
        after.struck[n], after.own[HAD, n] = struck, 1.0 if had or struck else 0.0
        after.own[IMPACT, n] = before.own[IMPACT, n]
        if struck:
            x_m, y_m = after.gap_m[first, n], after.aside_m[first, n]
            begin_m, aside_m = before.gap_m[first, n] + length_m, before.aside_m[first, n]
            after.struck_m[0, n], after.struck_m[1, n] = x_m - next_x_m - begin_m, y_m - aside_m
            begin_m = ego_x_m + begin_m
            after.gap_m[first, n] = begin_m + least * (x_m - begin_m)
            after.aside_m[first, n] = aside_m + least * (y_m - aside_m)
            after.speed_mps[first, n], after.own[V, n] = 0.0, 0.0
            after.own[X, n] = ego_x_m + least * (next_x_m - ego_x_m)
        for car in range(before.gap_m.shape[0]):
            after.gap_m[car, n] = after.gap_m[car, n] - after.own[X, n] - length_m
            speed_mps = after.speed_mps[car, n]
            over_m = speed_mps * numbers.dt_s if speed_mps > 0.0 else 1.0
            wanted = (done.next_m[car, n] - after.aside_m[car, n]) / over_m
            after.sine[car, n] = min(max(wanted, -numbers.largest_sine), numbers.largest_sine)


def reason(numbers: EncounterNumbers, before: Before, done: Done, after: After) -> None:
    """By how much the ego braked harder than there was a reason for, as in ``margins.py``."""
    for n in range(before.own.shape[1]):
        ego_mps, own_mps2 = before.own[V, n], -after.own[A, n]
        too_near, nearest, nearest_m = False, -1, np.inf
        for car in range(before.gap_m.shape[0]):
            gap_m = before.gap_m[car, n]
            if is_ahead(numbers, gap_m, before.aside_m[car, n]):
                margin_m = distance_margin(numbers, gap_m, ego_mps, before.along_mps[car, n])
                too_near = too_near or margin_m < 0.0
                if nearest < 0 or gap_m < nearest_m:
                    nearest, nearest_m = car, gap_m
        if nearest >= 0:
            stops_mps2 = before.speed_mps[nearest, n] / numbers.dt_s
            own_mps2 -= min(done.others_mps2[nearest, n], stops_mps2)
        needless = 0.0 if too_near else max(own_mps2, 0.0)
        after.own[NEED, n] = before.own[NEED, n] if after.own[HAD, n] > 0.0 else needless


def touch(
    numbers: EncounterNumbers, along_m: float, aside_m: float, later_m: float, later_aside_m: float
) -> float:
    """The least share of the step at which a car touches the ego, as in ``contact.py``."""
    enters, leaves = 0.0, 1.0
    for across in range(2):
        first = aside_m if across else along_m
        moved = (later_aside_m if across else later_m) - first
        reach = numbers.width_m if across else numbers.length_m
        if moved == 0.0:
            if abs(first) > reach:
                return np.inf
        else:
            one, other = (-reach - first) / moved, (reach - first) / moved
            enters, leaves = max(enters, min(one, other)), min(leaves, max(one, other))
    return enters if enters <= leaves else np.inf


def is_ahead(numbers: EncounterNumbers, gap_m: float, aside_m: float) -> bool:
    """Whether a car is ahead in lane, as in ``margins.py``."""
    return abs(aside_m) < numbers.lane_reach_m and gap_m + numbers.length_m > 0.0


def distance_margin(
    numbers: EncounterNumbers, gap_m: float, ego_mps: float, along_mps: float
) -> float:
    """A gap less the safe distance, as in ``margins.py``."""
    braking_m = (ego_mps * ego_mps - along_mps * along_mps) / (2.0 * numbers.hard_deceleration_mps2)
    return gap_m - max(braking_m + numbers.reaction_time_s * ego_mps, 0.0)


def judge(numbers: EncounterNumbers, before: Before, after: After, turned: Turned) -> None:
    """What rules ask for at the next states."""
    along_mps = turned.along_mps
    for n in range(before.own.shape[1]):
        ego_mps, collided = after.own[V, n], after.own[HAD, n] > 0.0
        nearest, nearest_m, clear_m = -1, np.inf, np.inf
        for car in range(after.gap_m.shape[0]):
            gap_m, aside_m = after.gap_m[car, n], after.aside_m[car, n]
            along_m = abs(gap_m + numbers.length_m) - numbers.length_m
            clear_m = min(clear_m, max(along_m, abs(aside_m) - numbers.width_m))
            after.states_ahead[car, n] = 0
            if is_ahead(numbers, gap_m, aside_m) and (nearest < 0 or gap_m < nearest_m):
                nearest, nearest_m = car, gap_m
        after.own[CLEAR, n] = 0.0 if collided else clear_m
        safe_m = numbers.gap_bound_m
        if nearest >= 0:
            states_ahead = before.states_ahead[nearest, n] + 1
            after.states_ahead[nearest, n] = states_ahead
            if states_ahead > numbers.recovery_steps:
                own_m = distance_margin(numbers, nearest_m, ego_mps, along_mps[nearest, n])
                safe_m = max(min(safe_m, own_m), -numbers.gap_bound_m)
        after.own[SAFE, n] = before.own[SAFE, n] if collided else safe_m
        after.own[AVOID, n] = before.own[AVOID, n]
        if numbers.cuts_in and not collided:
            half_m = numbers.width_m / 2
            was_in = abs(before.aside_m[0, n]) - half_m <= numbers.in_lane_m
            is_in = abs(after.aside_m[0, n]) - half_m <= numbers.in_lane_m
            if is_in and not was_in:
                seen = not turned.time_s < turned.seen_from_s[n]
                closing_mps = ego_mps - along_mps[0, n]
                after.own[AVOID, n] = avoidable_by(numbers, closing_mps, after.gap_m[0, n], seen)


def avoidable_by(numbers: EncounterNumbers, closing_mps: float, gap_m: float, seen: bool) -> float:
    """The regulation's margin of a car that has come into the lane, as in ``margins.py``."""
    if not seen:
        return numbers.unavoidable_s
    if not closing_mps > 0.0:
        return -numbers.unavoidable_s
    needed_s = closing_mps / (2.0 * numbers.assumed_mps2) + numbers.assumed_delay_s
    margin_s = gap_m / closing_mps - needed_s
    return min(max(margin_s, numbers.unavoidable_s), -numbers.unavoidable_s)
