"""Plain rollouts of the braking scenario by a compiled loop, where numba is installed.

The scenario without tracker or position errors, outcomes sampled from the error model: what takes a
million rollouts to tell anything. The loops over rollouts and steps have the same arithmetic in the
same order as ``pemviz.simulators.braking.vectorized``, so that both give the same numbers to the
last bit. What the error model answers is kept by gap in a hash table with open addressing: rollouts
meet few gaps, since equal outcomes lead to equal states. For gaps not met before the model is
evaluated for all together, by numpy.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED, SPEED_ERROR_INTEGRAL
from pemviz.types import RolloutBatch, Simulator

LOG = logging.getLogger(__name__)
Logit = Callable[[FloatArray], FloatArray]
"""An error model's answer to salient variables ``[n, 11]``, each on its own."""
FEWEST_PLACES, MOST_PLACES = 1 << 14, 1 << 22
"""Of a table of answers, at most half of them taken; a full one is begun anew (96 MB)."""
EMPTY = np.uint64(0x7FF8_0000_0000_BEEF)
"""Bits of a NaN that no arithmetic gives: a place of the table without a gap."""
MULTIPLIER = np.uint64(0x9E37_79B9_7F4A_7C15)
"""Odd; 2^64 over the golden ratio."""
ONE = np.uint64(1)
BLOCK = 128
"""Rollouts that are taken through all steps together: their numbers fit the processor's cache."""


class Answers(NamedTuple):
    """An error model's answers by gap: a hash table of 2^(64 - shift) places, half of them used.

    Attributes:
        bits: Of the gap in each place, or ``EMPTY``.
        logit: Of 'detected' there.
        miss: Probability of a miss there; NaN where the model has not been evaluated.
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
        lead_mps: Speeds of the lead car ``[T]`` [m/s], equal in all.
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


def advance(
    tracks: Tracks, answers: Answers, uniforms: FloatArray, rows: IntArray, numbers: Numbers
) -> None:
    """Take rollouts on to their last state, or to a gap that has no answer.

    From there they go on by a guess, as if it had been detected, so that the model is evaluated
    for the gaps that they come to together: each takes a place in the table, while there is room,
    without an answer yet. What is written of a rollout is right up to the state that it reached.

    Args:
        tracks: N rollouts.
        answers: The error model's, by which outcomes are sampled.
        uniforms: ``[N, T-1]``, from 0 to 1.
        rows: Which rollouts to take on, ``[M]``.
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


class Scenario(Simulator, Protocol):
    """The scenario by numpy, from which the first state and the lead car's way are taken."""

    @property
    def config(self) -> ScenarioConfig:
        """Its numbers."""
        ...


@dataclass(frozen=True)
class Loops:
    """The loops, compiled or not."""

    advance: Callable[..., None] = advance
    insert: Callable[..., None] = insert


@cache
def compiled_loops() -> Loops | None:
    """The compiled functions, kept on disk; ``None`` without numba, or with one that fails here."""
    if find_spec("numba") is None:
        return None
    try:
        njit: Any = import_module("numba").njit
        for kept in (True, False):  # what an earlier version left on disk may not be readable
            try:
                found = Loops(njit(advance, cache=kept), njit(insert, cache=kept))
                found.insert(_answers(2), *np.empty((3, 0), dtype=np.uint64))
            except Exception:
                if not kept:
                    raise
                continue
            return found
    except Exception as error:  # an installation of others may raise anything
        LOG.warning("numba cannot be used (%s); numpy computes", error)
    return None


class CompiledRollouts:
    """Plain rollouts of one scenario with one error model, whose answers it keeps."""

    def __init__(self, simulator: Scenario, logit: Logit, kernels: Loops) -> None:
        self.simulator, self.logit = simulator, logit
        self._kernels, self._lead_mps = kernels, lead_speeds(simulator)
        self._answers = _answers(FEWEST_PLACES)
        config = simulator.config
        self._numbers = Numbers(
            dt=config.dt_s,
            target=config.initial_speed_mps,
            gain=config.speed_gain_per_s,
            integral_gain=config.speed_integral_gain_per_s2,
            lowest=-config.maximum_deceleration_mps2,
            highest=config.maximum_acceleration_mps2,
            close=config.emergency_gap_m,
            emergency=-config.emergency_deceleration_mps2,
        )

    def simulate(self, uniforms: FloatArray) -> RolloutBatch:
        """As :func:`pemviz.sampling.rollouts.simulate.simulate`, for ``uniforms [N, T-1]``."""
        count, steps = uniforms.shape
        (gap_m, ego_mps, lead_mps), tracks = self.begun(count)
        waiting = np.arange(count)
        while waiting.size:
            known = int(self._answers.held[0])
            self.advance(tracks, uniforms, waiting)
            self._evaluate(known)
            waiting = waiting[tracks.reached[waiting] < steps]
        logit = tracks.logit.T
        return RolloutBatch(
            signals={GAP: gap_m.T, EGO_SPEED: ego_mps.T, LEAD_SPEED: lead_mps.T},
            memory={SPEED_ERROR_INTEGRAL: tracks.integral_m.T},
            detected=tracks.detected.T,
            pem_logit=logit,
            proposal_logit=logit,
        )

    def begun(self, count: int) -> tuple[FloatArray, Tracks]:
        """Of ``count`` rollouts at their first state signals ``[3, T, N]``, and what is written."""
        steps = self.simulator.states - 1
        signals = np.empty((3, steps + 1, count))
        gap_m, ego_mps, lead_mps = signals
        first = self.simulator.initial(count=count)
        tracks = Tracks(
            gap_m=gap_m,
            gap_bits=gap_m.view(np.uint64),
            ego_mps=ego_mps,
            integral_m=np.empty((steps + 1, count)),
            detected=np.empty((steps, count), dtype=np.bool_),
            logit=np.empty((steps, count)),
            lead_mps=self._lead_mps,
            reached=np.zeros(count, dtype=np.int64),
        )
        gap_m[0], ego_mps[0] = first.signals[GAP], first.signals[EGO_SPEED]
        tracks.integral_m[0] = first.memory[SPEED_ERROR_INTEGRAL]
        lead_mps[:] = self._lead_mps[:, None]
        return signals, tracks

    def advance(self, tracks: Tracks, uniforms: FloatArray, rows: IntArray) -> None:
        """Take rollouts ``rows [M]`` on by ``uniforms [N, T-1]``, to gaps not met before."""
        self._kernels.advance(tracks, self._answers, uniforms, rows, self._numbers)

    def _evaluate(self, known: int) -> None:
        """Evaluate the model for gaps that have taken places since there were ``known``.

        A table that is full is put into one with twice the places, or, where that would become
        too large, begun anew: such states hardly ever come again.
        """
        answers = self._answers
        places = answers.taken[known : int(answers.held[0])]
        if places.size == 0 and known < answers.taken.size:
            return
        gap_m = answers.bits[places].view(np.float64)
        logit = self.logit(self.simulator.salient({GAP: gap_m}))
        answers.logit[places], answers.miss[places] = logit, expit(-logit)
        if answers.held[0] < answers.taken.size:
            return
        larger, kept = 2 * answers.bits.size, answers.taken
        self._answers = _answers(FEWEST_PLACES if larger > MOST_PLACES else larger)
        if larger <= MOST_PLACES:
            known_before = (answers.bits[kept], answers.logit[kept], answers.miss[kept])
            self._kernels.insert(self._answers, *known_before)


def _answers(places: int) -> Answers:
    """A table without any."""
    return Answers(
        bits=np.full(places, EMPTY),
        logit=np.empty(places),
        miss=np.full(places, np.nan),
        shift=np.uint64(65 - places.bit_length()),
        taken=np.empty(places // 2, dtype=np.int64),
        held=np.zeros(1, dtype=np.int64),
    )


def lead_speeds(simulator: Scenario) -> FloatArray:
    """The lead car's speeds ``[T]`` [m/s], which no outcome changes."""
    states, found = simulator.initial(count=1), np.empty(simulator.states)
    for step in range(simulator.states):
        found[step] = states.signals[LEAD_SPEED][0]
        states = simulator.step(states, np.ones(1, dtype=np.bool_))
    return found
