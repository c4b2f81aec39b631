"""Rollouts: the scenario stepped with outcomes drawn from a proposal."""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.types import Proposal, RolloutBatch, Simulator, StateBatch

LogitFunction = Callable[[FloatArray], FloatArray]
"""Salient variables ``[..., D]`` to the logit ``[...]`` of 'detected'."""


def simulate(
    *, simulator: Simulator, pem_logit: LogitFunction, proposal: Proposal, uniforms: FloatArray
) -> RolloutBatch:
    """Roll out the scenario once for each row of ``uniforms``.

    Args:
        simulator: The scenario.
        pem_logit: The perception error model.
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
    tracks = _Tracks(states, simulator.states)
    for step in range(steps):
        under_pem[step] = pem_logit(simulator.salient(states.signals))
        under_proposal[step] = proposal.logit(states, under_pem[step])
        detected[step] = uniforms[:, step] >= expit(-under_proposal[step])
        states = simulator.step(states, detected[step])
        tracks.record(step + 1, states)
    return RolloutBatch(
        signals=tracks.signals(),
        memory=tracks.memory(),
        detected=detected.T,
        pem_logit=under_pem.T,
        proposal_logit=under_proposal.T,
    )


def replay(*, simulator: Simulator, detected: BoolArray) -> Mapping[str, FloatArray]:
    """Signals ``[N, T]`` of rollouts with given outcomes ``[N, T-1]``."""
    states = simulator.initial(count=detected.shape[0])
    tracks = _Tracks(states, simulator.states)
    by_step = np.ascontiguousarray(detected.T)
    for step in range(simulator.states - 1):
        states = simulator.step(states, by_step[step])
        tracks.record(step + 1, states)
    return tracks.signals()


class _Tracks:
    """States as they come, kept time-major so that each step writes one contiguous row."""

    def __init__(self, first: StateBatch, states: int) -> None:
        self._signals = {n: np.empty((states, *v.shape)) for n, v in first.signals.items()}
        self._memory = {n: np.empty((states, *v.shape), v.dtype) for n, v in first.memory.items()}
        self.record(0, first)

    def record(self, index: int, states: StateBatch) -> None:
        for name, values in states.signals.items():
            self._signals[name][index] = values
        for name, values in states.memory.items():
            self._memory[name][index] = values

    def signals(self) -> dict[str, FloatArray]:
        return {name: values.T for name, values in self._signals.items()}

    def memory(self) -> dict[str, AnyArray]:
        return {name: values.T for name, values in self._memory.items()}
