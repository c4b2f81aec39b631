"""Plain rollouts of the braking scenario by a compiled loop, where numba is installed.

The scenario without tracker, memory of misses or position errors, a shipped error model, outcomes
drawn from that model: what takes a million rollouts to tell anything. What comes out is what numpy
gives, to the last bit. The error model's answers are kept by gap; of gaps not met before it is
asked together, by numpy, which simulates all other scenarios.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit

from pemviz.arrays import FloatArray, IntArray
from pemviz.pem.models.card import Carded
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.rollouts.batches import BatchTask, Simulated, by_numpy
from pemviz.sampling.rollouts.compiled_replay import is_plain
from pemviz.sampling.rollouts.kernels import Loops, compiled_loops, lead_speeds
from pemviz.simulators.braking import loops
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED, SPEED_ERROR_INTEGRAL
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import Proposal, RolloutBatch, Simulator

FIRST_BY_NUMPY = 20_000
"""Rollouts after which loading the compiled loop, about half a second, begins to pay."""
FEWEST_PLACES, MOST_PLACES = 1 << 14, 1 << 22
"""Of a table of answers, at most half of them taken; a full one is begun anew (96 MB)."""


def is_served(simulator: Simulator, pem: Pem, proposal: Proposal) -> bool:
    """Whether the compiled loop knows the scenario, and whom outcomes are drawn from."""
    return (
        is_plain(simulator)
        and isinstance(pem, Carded)  # its answer to a state depends on that state alone
        and type(proposal) is PemProposal
    )


class CompiledRollouts:
    """Plain rollouts of one scenario with one error model, whose answers it keeps."""

    def __init__(self, simulator: VectorizedSimulator, pem: Pem, kernels: Loops) -> None:
        self.simulator, self.pem = simulator, pem
        self._kernels, self._lead_mps = kernels, lead_speeds(simulator.config)
        self._clear(FEWEST_PLACES)

    def _clear(self, places: int) -> None:
        self._answers = loops.Answers(
            bits=np.full(places, loops.EMPTY),
            logit=np.empty(places),
            miss=np.full(places, np.nan),
            shift=np.uint64(65 - places.bit_length()),
            taken=np.empty(places // 2, dtype=np.int64),
            held=np.zeros(1, dtype=np.int64),
        )

    def simulate(self, uniforms: FloatArray) -> RolloutBatch:
        """As :func:`pemviz.sampling.rollouts.draw.simulate`, for ``uniforms [N, T-1]``."""
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
        logit = self.pem.logit(self.simulator.salient({GAP: gap_m}))
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


@dataclass
class CompiledRunner:
    """Simulates batches here, most of many by the compiled loop; a ``BatchRunner``.

    Attributes:
        first_by_numpy: Rollouts that numpy simulates before the loop is compiled or loaded.
        simulated: Who simulates what this loop does not know.
    """

    first_by_numpy: int = FIRST_BY_NUMPY
    simulated: Simulated = by_numpy
    _done: int = field(default=0, init=False)
    _rollouts: CompiledRollouts | None = field(default=None, init=False, repr=False)

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks``, in order."""
        for task in tasks:
            compiled = self._compiled(simulator, pem, task)
            if compiled is None:
                yield self.simulated(simulator, pem, task)
            else:
                yield compiled.simulate(task.uniforms)

    def _compiled(self, simulator: Simulator, pem: Pem, task: BatchTask) -> CompiledRollouts | None:
        if not is_served(simulator, pem, task.proposal):
            return None
        self._done += len(task.uniforms)
        kernels = compiled_loops() if self._done > self.first_by_numpy else None
        if kernels is None:
            return None
        known = self._rollouts
        if known is None or known.simulator is not simulator or known.pem is not pem:
            assert isinstance(simulator, VectorizedSimulator)  # noqa: S101  it is served
            self._rollouts = known = CompiledRollouts(simulator, pem, kernels)
        return known
