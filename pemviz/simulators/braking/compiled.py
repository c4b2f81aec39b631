"""Plain rollouts of the braking scenario by a compiled loop, where numba is installed.

The scenario without tracker or position errors, outcomes drawn from the error model: what takes a
million rollouts to tell anything. What comes out is what numpy gives, to the last bit. The error
model's answers are kept by gap; of gaps not met before it is asked together, by numpy.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
from scipy.special import expit

from pemviz.arrays import FloatArray, IntArray
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking import loops
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED, SPEED_ERROR_INTEGRAL
from pemviz.types import RolloutBatch, Simulator

LOG = logging.getLogger(__name__)
Logit = Callable[[FloatArray], FloatArray]
"""An error model's answer to salient variables ``[n, 11]``, each on its own."""
FEWEST_PLACES, MOST_PLACES = 1 << 14, 1 << 22
"""Of a table of answers, at most half of them taken; a full one is begun anew (96 MB)."""


class Scenario(Simulator, Protocol):
    """The scenario by numpy, from which the first state and the lead car's way are taken."""

    @property
    def config(self) -> ScenarioConfig:
        """Its numbers."""
        ...


@dataclass(frozen=True)
class Loops:
    """The functions of :mod:`pemviz.simulators.braking.loops`, compiled or not."""

    advance: Callable[..., None] = loops.advance
    insert: Callable[..., None] = loops.insert


@cache
def compiled_loops() -> Loops | None:
    """The compiled functions, kept on disk; ``None`` without numba, or with one that fails here."""
    if find_spec("numba") is None:
        return None
    try:
        njit: Any = import_module("numba").njit
        for kept in (True, False):  # what an earlier version left on disk may not be readable
            try:
                found = Loops(njit(loops.advance, cache=kept), njit(loops.insert, cache=kept))
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
        self._clear(FEWEST_PLACES)

    def _clear(self, places: int) -> None:
        self._answers = _answers(places)

    def simulate(self, uniforms: FloatArray) -> RolloutBatch:
        """As :func:`pemviz.sampling.rollouts.simulate.simulate`, for ``uniforms [N, T-1]``."""
        count, steps = uniforms.shape
        (gap_m, ego_mps, lead_mps), tracks = self.begun(count)
        waiting = np.arange(count)
        while waiting.size:
            known = int(self._answers.held[0])
            self.advance(tracks, uniforms, waiting)
            self._ask(known)
            waiting = waiting[tracks.reached[waiting] < steps]
        logit = tracks.logit.T
        return RolloutBatch(
            signals={GAP: gap_m.T, EGO_SPEED: ego_mps.T, LEAD_SPEED: lead_mps.T},
            memory={SPEED_ERROR_INTEGRAL: tracks.integral_m.T},
            detected=tracks.detected.T,
            pem_logit=logit,
            proposal_logit=logit,
        )

    def begun(self, count: int) -> tuple[FloatArray, loops.Tracks]:
        """Of ``count`` rollouts at their first state signals ``[3, T, N]``, and what is written."""
        steps = self.simulator.states - 1
        signals = np.empty((3, steps + 1, count))
        gap_m, ego_mps, lead_mps = signals
        first = self.simulator.initial(count=count)
        tracks = loops.Tracks(
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

    def advance(self, tracks: loops.Tracks, uniforms: FloatArray, rows: IntArray) -> None:
        """Take rollouts ``rows [M]`` on by ``uniforms [N, T-1]``, to gaps not met before."""
        numbers = loops.numbers_of(self.simulator.config)
        self._kernels.advance(tracks, self._answers, uniforms, rows, numbers)

    def _ask(self, known: int) -> None:
        """Ask the error model about gaps that have taken places since there were ``known``."""
        answers = self._answers
        places = answers.taken[known : int(answers.held[0])]
        if places.size == 0 and known < answers.taken.size:
            return
        gap_m = answers.bits[places].view(np.float64)
        logit = self.logit(self.simulator.salient({GAP: gap_m}))
        answers.logit[places], answers.miss[places] = logit, expit(-logit)
        if answers.held[0] == answers.taken.size:
            self._make_room()

    def _make_room(self) -> None:
        """Twice the places; a table that would become too large is begun anew."""
        before = self._answers
        places = 2 * before.bits.size
        if places > MOST_PLACES:  # states that hardly ever come again
            self._clear(FEWEST_PLACES)
            return
        self._clear(places)
        kept = before.taken
        self._kernels.insert(
            self._answers, before.bits[kept], before.logit[kept], before.miss[kept]
        )


def _answers(places: int) -> loops.Answers:
    """A table without any."""
    return loops.Answers(
        bits=np.full(places, loops.EMPTY),
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
