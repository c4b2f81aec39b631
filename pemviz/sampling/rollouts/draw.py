"""Rollouts: the scenario stepped with outcomes drawn from a proposal."""

from collections.abc import Mapping

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.pem.models.protocol import Pem
from pemviz.types import Proposal, RolloutBatch, Simulator


def simulate(
    *, simulator: Simulator, pem: Pem, proposal: Proposal, uniforms: FloatArray
) -> RolloutBatch:
    """Roll out the scenario once for each row of ``uniforms``.

    Args:
        simulator: The scenario.
        pem: The perception error model.
        proposal: What outcomes are drawn from.
        uniforms: ``[N, T-1]`` independent draws from [0, 1); a step misses where its draw
            is below the probability of a miss.

    Returns:
        N rollouts.
    """
    count = uniforms.shape[0]
    steps = simulator.states - 1
    detected = np.empty((steps, count), dtype=np.bool_)
    under_pem = np.empty((steps, count))
    under_proposal = np.empty((steps, count))
    states = simulator.initial(count=count)
    signals = _Track(states.signals, simulator.states)
    memory = _Track(states.memory, simulator.states)
    for step in range(steps):
        under_pem[step] = pem.logit(simulator.salient(states.signals))
        under_proposal[step] = proposal.logit(states, under_pem[step])
        detected[step] = uniforms[:, step] >= expit(-under_proposal[step])
        states = simulator.step(states, detected[step])
        signals.record(step + 1, states.signals)
        memory.record(step + 1, states.memory)
    return RolloutBatch(
        signals=signals.by_rollout(),
        memory=memory.by_rollout(),
        detected=detected.T,
        pem_logit=under_pem.T,
        proposal_logit=under_proposal.T,
    )


def replay(*, simulator: Simulator, detected: BoolArray) -> Mapping[str, FloatArray]:
    """Signals ``[N, T]`` of rollouts with given outcomes ``[N, T-1]``."""
    states = simulator.initial(count=detected.shape[0])
    signals = _Track(states.signals, simulator.states)
    by_step = np.ascontiguousarray(detected.T)
    for step in range(simulator.states - 1):
        states = simulator.step(states, by_step[step])
        signals.record(step + 1, states.signals)
    return signals.by_rollout()


class _Track:
    """Named values as they come, kept time-major: each step writes one contiguous row.

    Values of a type share one block: fresh memory takes about as long as the arithmetic of the
    vectorized back end, and a large block comes in large pages.
    """

    def __init__(self, first: Mapping[str, AnyArray], states: int) -> None:
        self._values = dict(first)
        for dtype in {array.dtype for array in first.values()}:
            names = [name for name, array in first.items() if array.dtype == dtype]
            block = np.empty((len(names), states, *first[names[0]].shape), dtype)
            self._values.update(zip(names, block, strict=True))
        self.record(0, first)

    def record(self, index: int, values: Mapping[str, AnyArray]) -> None:
        for name, array in values.items():
            self._values[name][index] = array

    def by_rollout(self) -> dict[str, AnyArray]:
        return {name: array.T for name, array in self._values.items()}
