"""The braking scenario as plain loops over rollouts and steps, for a compiler to translate.

The same arithmetic in the same order as ``pemviz.simulators.braking.vectorized``, so that both
give the same numbers to the last bit. What the error model answers is looked up by gap in a hash
table with open addressing: rollouts meet few gaps, since equal outcomes lead to equal states.
"""

from typing import Any, NamedTuple

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.config import ScenarioConfig

EMPTY = np.uint64(0x7FF8_0000_0000_BEEF)
"""Bits of a NaN that no arithmetic gives: a place of the table without a gap."""
MULTIPLIER = np.uint64(0x9E37_79B9_7F4A_7C15)
"""Odd; 2^64 over the golden ratio."""
BLOCK = 64
"""Rollouts that are taken through all steps together: their draws fit the processor's cache."""
REPLAYED_TOGETHER = 1024
"""The same where outcomes are given and nothing is looked up."""


class Answers(NamedTuple):
    """An error model's answers by gap: a hash table of 2^(64 - shift) places.

    Attributes:
        bits: Of the gap in each place, or ``EMPTY``.
        logit: Of 'detected' there.
        miss: Probability of a miss there.
        shift: Of 64-bit hashes.
    """

    bits: Any
    logit: FloatArray
    miss: FloatArray
    shift: Any


class Tracks(NamedTuple):
    """N rollouts, time-major; written as they go on.

    Attributes:
        gap_m: ``[T, N]`` [m].
        gap_bits: The same memory as 64-bit numbers.
        ego_mps: Speeds of the ego ``[T, N]`` [m/s].
        integral_m: Its speed error integral ``[T, N]`` [m].
        detected: ``[T-1, N]``.
        logit: The error model's ``[T-1, N]``.
        reached: The state ``[N]`` that each has come to.
    """

    gap_m: FloatArray
    gap_bits: Any
    ego_mps: FloatArray
    integral_m: FloatArray
    detected: BoolArray
    logit: FloatArray
    reached: IntArray


class Numbers(NamedTuple):
    """What the loop takes of a scenario, in SI units; see ``pemviz.config.ScenarioConfig``."""

    dt: float
    target: float
    gain: float
    integral_gain: float
    lowest: float
    highest: float
    close: float
    emergency: float


def numbers_of(config: ScenarioConfig) -> Numbers:
    """The numbers of a scenario."""
    return Numbers(
        dt=config.dt_s,
        target=config.initial_speed_mps,
        gain=config.speed_gain_per_s,
        integral_gain=config.speed_integral_gain_per_s2,
        lowest=-config.maximum_deceleration_mps2,
        highest=config.maximum_acceleration_mps2,
        close=config.emergency_gap_m,
        emergency=-config.emergency_deceleration_mps2,
    )


def moved(
    state: tuple[float, float, float], lead: float, detected: bool, numbers: Numbers
) -> tuple[float, float, float]:
    """Gap [m], ego speed [m/s] and its speed error integral [m] one step after ``state``.

    Args:
        state: The same before the step.
        lead: Speed of the lead car there [m/s].
        detected: Perception's outcome there.
        numbers: The scenario's.
    """
    gap, speed, held = state
    error = numbers.target - speed
    grown = error * numbers.dt + held
    wanted = error * numbers.gain + numbers.integral_gain * grown
    wanted = min(max(wanted, numbers.lowest), numbers.highest)
    brakes = detected & (gap < numbers.close)
    wanted = numbers.emergency if brakes else wanted
    grown = held if brakes else grown
    gap = (lead - speed) * numbers.dt + gap
    return gap, max(speed + wanted * numbers.dt, 0.0), grown


def advance(
    tracks: Tracks, answers: Answers, uniforms: FloatArray, lead_mps: FloatArray, numbers: Numbers
) -> None:
    """Take every rollout on to its last state, or to a gap that has no answer.

    Outcomes are drawn from the error model by ``uniforms [N, T-1]``; ``lead_mps [T]`` are the
    lead car's speeds.
    """
    count, steps = uniforms.shape
    bits, mask = answers.bits, answers.bits.size - 1
    for first in range(0, count, BLOCK):
        for step in range(steps):
            for n in range(first, min(first + BLOCK, count)):
                if tracks.reached[n] != step:
                    continue
                key = tracks.gap_bits[step, n]
                place = np.int64((key * MULTIPLIER) >> answers.shift)
                while bits[place] not in (key, EMPTY):
                    place = (place + 1) & mask
                if bits[place] != key:
                    continue
                speed, held = tracks.ego_mps[step, n], tracks.integral_m[step, n]
                detected = uniforms[n, step] >= answers.miss[place]
                tracks.logit[step, n] = answers.logit[place]
                tracks.detected[step, n] = detected
                gap = tracks.gap_m[step, n]
                state = gap, speed, held
                gap, speed, held = moved(state, lead_mps[step], detected, numbers)
                tracks.gap_m[step + 1, n] = gap
                tracks.ego_mps[step + 1, n] = speed
                tracks.integral_m[step + 1, n] = held
                tracks.reached[n] = step + 1


def insert(answers: Answers, bits: Any, logit: FloatArray, miss: FloatArray) -> int:
    """Put gaps into a table with room for them, but for those that are there; how many were not."""
    mask, new = answers.bits.size - 1, 0
    for n in range(bits.size):
        place = np.int64((bits[n] * MULTIPLIER) >> answers.shift)
        while answers.bits[place] not in (bits[n], EMPTY):
            place = (place + 1) & mask
        if answers.bits[place] == EMPTY:
            answers.bits[place] = bits[n]
            answers.logit[place], answers.miss[place] = logit[n], miss[n]
            new += 1
    return new


def replay(
    gap_m: FloatArray,
    ego_mps: FloatArray,
    detected: BoolArray,
    lead_mps: FloatArray,
    numbers: Numbers,
) -> None:
    """Take rollouts from their first state through all steps by given outcomes.

    Args:
        gap_m: ``[T, N]`` [m], of which the first row is there.
        ego_mps: Speeds of the ego ``[T, N]`` [m/s], likewise.
        detected: ``[T-1, N]``.
        lead_mps: Speeds of the lead car ``[T]`` [m/s].
        numbers: The scenario's.
    """
    steps, count = detected.shape
    held_m = np.empty(REPLAYED_TOGETHER)
    for first in range(0, count, REPLAYED_TOGETHER):
        last = min(first + REPLAYED_TOGETHER, count)
        held_m[:] = 0.0
        for step in range(steps):
            gap, speed, lead = gap_m[step, first:last], ego_mps[step, first:last], lead_mps[step]
            gap_after = gap_m[step + 1, first:last]
            speed_after = ego_mps[step + 1, first:last]
            outcome = detected[step, first:last]
            for n in range(last - first):
                state = gap[n], speed[n], held_m[n]
                state = moved(state, lead, outcome[n], numbers)
                gap_after[n], speed_after[n], held_m[n] = state
