"""Particles of multilevel splitting: rollouts that can be cut and continued."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.arrays import Batch, FloatArray, IntArray
from pemviz.sampling.problem import Problem
from pemviz.types import RolloutBatch, StateBatch


@dataclass(frozen=True)
class Particles(Batch):
    """N rollouts under the error model.

    Attributes:
        rollouts: The rollouts.
        score: ``[N, T]``: the robustness that each would have if, from each step on,
            everything were detected; running minimum. Its last column is no larger than the
            rollout's own robustness.
    """

    rollouts: RolloutBatch
    score: FloatArray

    @property
    def lowest(self) -> FloatArray:
        """The lowest score of each rollout, ``[N]``."""
        return self.score[:, -1]


def draw_particles(problem: Problem, *, count: int, generator: np.random.Generator) -> Particles:
    """``count`` independent rollouts."""
    steps = problem.simulator.states - 1
    start = problem.simulator.initial(count=count)
    empty = RolloutBatch(
        signals={name: np.zeros((count, steps + 1)) for name in start.signals},
        memory={
            name: np.zeros((count, steps + 1), dtype=values.dtype)
            for name, values in start.memory.items()
        },
        detected=np.zeros((count, steps), dtype=np.bool_),
        pem_logit=np.zeros((count, steps)),
        proposal_logit=np.zeros((count, steps)),
    ).map(np.asfortranarray)
    return _continued(problem, empty, np.zeros(count, dtype=np.int64), generator)


def restarted(
    problem: Problem, particles: Particles, *, cut: IntArray, generator: np.random.Generator
) -> Particles:
    """New rollouts that share the states up to ``cut [N]`` and go on independently."""
    return _continued(problem, particles.rollouts, cut, generator)


def _continued(
    problem: Problem, old: RolloutBatch, cut: IntArray, generator: np.random.Generator
) -> Particles:
    """Rollouts ``[N]`` drawn anew from step ``cut`` on; 0 draws them whole."""
    simulator = problem.simulator
    count, steps = old.detected.shape
    signals = {name: np.array(values) for name, values in old.signals.items()}
    memory = {name: np.array(values) for name, values in old.memory.items()}
    detected, logit = np.array(old.detected), np.array(old.pem_logit)
    uniforms = generator.random((count, steps))
    states = simulator.initial(count=count)
    score = np.empty((count, steps + 1), order="F")
    for step in range(steps + 1):
        for name, values in states.signals.items():
            signals[name][:, step] = values
        for name, values in states.memory.items():
            memory[name][:, step] = values
        problem.pause()
        score[:, step] = problem.robustness(_if_detected(problem, signals, states, step))
        if step == steps:
            break
        logit[:, step] = problem.pem.logit(simulator.salient(states.signals))
        fresh = uniforms[:, step] >= expit(-logit[:, step])
        detected[:, step] = np.where(step >= cut, fresh, detected[:, step])
        states = simulator.step(states, detected[:, step])
    return Particles(
        rollouts=RolloutBatch(
            signals=signals,
            memory=memory,
            detected=detected,
            pem_logit=logit,
            proposal_logit=logit,
        ),
        score=np.minimum.accumulate(score, axis=1),
    )


def _if_detected(
    problem: Problem, signals: dict[str, FloatArray], states: StateBatch, step: int
) -> dict[str, FloatArray]:
    """Signals ``[N, T]`` of the rollouts if everything is detected from ``step`` on."""
    simulator = problem.simulator
    result = {name: np.array(values) for name, values in signals.items()}
    everything = np.ones(next(iter(states.signals.values())).size, dtype=np.bool_)
    for later in range(step + 1, simulator.states):
        states = simulator.step(states, everything)
        for name, values in states.signals.items():
            result[name][:, later] = values
    return result
