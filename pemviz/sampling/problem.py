"""What a method is asked to solve: scenario, error model, specification, metric."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.sampling.rollout import LogitFunction, simulate
from pemviz.simulators.latched import Monitor
from pemviz.types import Proposal, RolloutBatch, ScoredRollouts, Simulator, StateBatch

Signals = Mapping[str, FloatArray]
BATCH_ROLLOUTS = 4096


def _no_progress(done: int, total: int) -> None:
    """Take no note of what is done."""


def _no_pause() -> None:
    """Go on."""


@dataclass(frozen=True)
class Problem:
    """A failure probability to be estimated.

    Attributes:
        simulator: The scenario.
        pem_logit: The perception error model.
        robustness: Signals ``[N, T]`` to the ranking metric's scores ``[N]``.
        violated: Signals ``[N, T]`` to the classical verdict ``[N]``.
        batch_rollouts: How many rollouts are simulated between two calls of ``progress``.
        progress: Told after every batch how many of a stage's rollouts are done, and of how
            many; may raise to stop a run.
        pause: Called now and then during long work between rollouts; may raise likewise.
        unsafe: States ``[N]`` to whether being in one of them is what violates the
            specification, ``[N]``; ``None`` where the verdict takes more than single states.
        monitor: Tells violations from the states so far where ``unsafe`` does not.
    """

    simulator: Simulator
    pem_logit: LogitFunction
    robustness: Callable[[Signals], FloatArray]
    violated: Callable[[Signals], BoolArray]
    batch_rollouts: int = BATCH_ROLLOUTS
    progress: Callable[[int, int], None] = _no_progress
    pause: Callable[[], None] = _no_pause
    unsafe: Callable[[StateBatch], BoolArray] | None = None
    monitor: Monitor | None = None


def sample(
    problem: Problem, *, proposal: Proposal, count: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    """Draw and score ``count`` rollouts, in batches that do not change the result."""
    generator = np.random.default_rng(seeds)
    steps = problem.simulator.states - 1
    batches: list[ScoredRollouts] = []
    for start in range(0, count, problem.batch_rollouts):
        size = min(problem.batch_rollouts, count - start)
        uniforms = generator.random((size, steps))
        began = time.perf_counter()
        rollouts = simulate(
            simulator=problem.simulator,
            pem_logit=problem.pem_logit,
            proposal=proposal,
            uniforms=uniforms,
        )
        simulated = time.perf_counter()
        scored = score(problem, rollouts)
        timings_s = {
            "simulation": simulated - began,
            "robustness": time.perf_counter() - simulated,
        }
        batches.append(replace(scored, timings_s=timings_s))
        problem.progress(start + size, count)
    return concatenated(batches)


def score(problem: Problem, rollouts: RolloutBatch) -> ScoredRollouts:
    """Robustness and verdict of rollouts."""
    return ScoredRollouts(
        rollouts=rollouts,
        robustness=problem.robustness(rollouts.signals),
        violated=problem.violated(rollouts.signals),
    )


def concatenated(batches: Sequence[ScoredRollouts]) -> ScoredRollouts:
    """One batch of at least one, in order; timings add up."""
    if len(batches) == 1:
        return batches[0]
    parts = [batch.rollouts for batch in batches]
    return ScoredRollouts(
        rollouts=RolloutBatch(
            signals={n: np.concatenate([p.signals[n] for p in parts]) for n in parts[0].signals},
            memory={n: np.concatenate([p.memory[n] for p in parts]) for n in parts[0].memory},
            detected=np.concatenate([part.detected for part in parts]),
            pem_logit=np.concatenate([part.pem_logit for part in parts]),
            proposal_logit=np.concatenate([part.proposal_logit for part in parts]),
        ),
        robustness=np.concatenate([batch.robustness for batch in batches]),
        violated=np.concatenate([batch.violated for batch in batches]),
        timings_s={
            part: sum(batch.timings_s[part] for batch in batches) for part in batches[0].timings_s
        },
    )
