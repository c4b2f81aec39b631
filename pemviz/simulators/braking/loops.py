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
ONE = np.uint64(1)
BLOCK = 128
"""Rollouts that are taken through all steps together: their draws fit the processor's cache."""


class Answers(NamedTuple):
    """An error model's answers by gap: a hash table of 2^(64 - shift) places, half of them used.

    Attributes:
        bits: Of the gap in each place, or ``EMPTY``.
        logit: Of 'detected' there.
        miss: Probability of a miss there; NaN where the model has not been asked.
        shift: Of 64-bit hashes.
        taken: The places that are taken, in the order in which they were.
        held: How many these are, ``[1]``.
    """

    bits: Any
    logit: FloatArray
    miss: FloatArray
    shift: Any
    taken: IntArray
    held: IntArray


class Tracks(NamedTuple):
    """N rollouts, time-major; written as they go on.

    Attributes:
        gap_m: ``[T, N]`` [m].
        gap_bits: The same memory as 64-bit numbers.
        ego_mps: Speeds of the ego ``[T, N]`` [m/s].
        integral_m: Its speed error integral ``[T, N]`` [m].
        detected: ``[T-1, N]``.
        logit: The error model's ``[T-1, N]``.
        lead_mps: Speeds of the lead car ``[T]`` [m/s], alike in all.
        reached: The state ``[N]`` that each has come to for certain.
    """

    gap_m: FloatArray
    gap_bits: Any
    ego_mps: FloatArray
    integral_m: FloatArray
    detected: BoolArray
    logit: FloatArray
    lead_mps: FloatArray
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


def advance(
    tracks: Tracks, answers: Answers, uniforms: FloatArray, rows: IntArray, numbers: Numbers
) -> None:
    """Take rollouts on to their last state, or to a gap that has no answer.

    From there they go on by a guess, as if it had been detected, so that the gaps that they come to
    are asked for together: each takes a place in the table, while there is room, without an answer
    yet. What is written of a rollout is right up to the state that it has reached.

    Args:
        tracks: N rollouts.
        answers: The error model's, by which outcomes are drawn.
        uniforms: Draws ``[N, T-1]``.
        rows: Which rollouts, ``[M]``.
        numbers: The scenario's.
    """
    bits, mask = answers.bits, np.uint64(answers.bits.size - 1)
    for first in range(0, rows.size, BLOCK):
        block = rows[first : first + BLOCK]
        for step in range(uniforms.shape[1]):
            gap, speed, held = tracks.gap_m[step], tracks.ego_mps[step], tracks.integral_m[step]
            gap_after, speed_after = tracks.gap_m[step + 1], tracks.ego_mps[step + 1]
            held_after, key_of, lead = (
                tracks.integral_m[step + 1], tracks.gap_bits[step], tracks.lead_mps[step],
            )  # fmt: skip
            for row in block:
                n = np.uint64(row)  # so that the compiler need not expect negative indices
                if tracks.reached[n] > step:
                    continue
                key = key_of[n]
                place = (key * MULTIPLIER) >> answers.shift
                while bits[place] not in (key, EMPTY):
                    place = (place + ONE) & mask
                if bits[place] != key and answers.held[0] < answers.taken.size:
                    bits[place] = key
                    answers.taken[answers.held[0]] = place
                    answers.held[0] += 1
                miss = answers.miss[place]
                detected = not uniforms[n, step] < miss  # true for NaN
                tracks.logit[step, n] = answers.logit[place]
                tracks.detected[step, n] = detected
                error = numbers.target - speed[n]
                grown = error * numbers.dt + held[n]
                wanted = error * numbers.gain + numbers.integral_gain * grown
                wanted = min(max(wanted, numbers.lowest), numbers.highest)
                brakes = detected & (gap[n] < numbers.close)
                wanted = numbers.emergency if brakes else wanted
                gap_after[n] = (lead - speed[n]) * numbers.dt + gap[n]
                speed_after[n] = max(speed[n] + wanted * numbers.dt, 0.0)
                held_after[n] = held[n] if brakes else grown
                if tracks.reached[n] == step and not np.isnan(miss):
                    tracks.reached[n] = step + 1


def insert(answers: Answers, bits: Any, logit: FloatArray, miss: FloatArray) -> None:
    """Put gaps that are not there into a table with room for them."""
    mask = np.uint64(answers.bits.size - 1)
    for n in range(bits.size):
        place = (bits[n] * MULTIPLIER) >> answers.shift
        while answers.bits[place] != EMPTY:
            place = (place + ONE) & mask
        answers.bits[place], answers.logit[place], answers.miss[place] = bits[n], logit[n], miss[n]
        answers.taken[answers.held[0]] = place
        answers.held[0] += 1
