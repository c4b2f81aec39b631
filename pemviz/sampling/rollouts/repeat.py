"""Whether rollouts are the same again: some of a stage are simulated a second time.

Weights and causes take for granted that outcomes and latents decide a rollout, and that the error
model answers the same to the same state. Randomness of a simulator's own, too rare for the trial
before a run, or a model that remembers what it was asked, would make an answer wrong without a
trace: in what is drawn once it cannot be seen.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.faults import of_no_rollouts
from pemviz.latents import Latents, StandardNormals
from pemviz.sampling.problem import Problem, in_time
from pemviz.sampling.rollouts.runners import BatchTask
from pemviz.simulators.check import ROUNDING
from pemviz.types import RolloutBatch, ScoredRollouts, StateBatch

SHARE = 0.02
"""Of a stage's rollouts."""
MOST = 32
"""Of a stage: what happens in one of ten rollouts is then found in 97 % of stages."""
LOGIT_ROUNDING = 1e-3
"""What a logit may differ by: networks in single precision round as their batch is laid out."""


@dataclass(frozen=True)
class Repeats:
    """Rollouts that were simulated a second time.

    Attributes:
        count: How many.
        differing: How many of them went otherwise.
        example: What differed in the first of these, in words; empty if none did.
    """

    count: int = 0
    differing: int = 0
    example: str = ""

    def __add__(self, other: "Repeats") -> "Repeats":
        return Repeats(
            self.count + other.count,
            self.differing + other.differing,
            self.example or other.example,
        )


def repeat_some(problem: Problem, scored: ScoredRollouts) -> Repeats:
    """Simulate a share of a stage's rollouts again, with the same outcomes and latents.

    Half of them are the violations that weigh most, as they carry the answer; the others lie evenly
    over the stage.

    Raises:
        SimulationError: What is simulated raises something, or takes too long.
    """
    once = scored.rollouts.take(_chosen(scored))
    task = BatchTask(
        _GivenOutcomes(once.detected),
        np.full(once.detected.shape, 0.5),
        None if once.latents is None else _as_normals(once.latents),
    )
    with of_no_rollouts():
        again = in_time(
            problem, lambda: next(problem.run_batches(problem.simulator, problem.pem, iter([task])))
        )
    return _compared(problem, once, again)


@dataclass(frozen=True)
class _GivenOutcomes:
    """Certain of the outcomes ``[N, T-1]`` that N rollouts had."""

    detected: BoolArray

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:  # noqa: ARG002
        return np.where(self.detected[:, int(states.step)], np.inf, -np.inf)

    def arrays(self) -> Mapping[str, AnyArray]:
        return {"detected": self.detected}

    def rows(self, rows: slice) -> "_GivenOutcomes":
        return _GivenOutcomes(self.detected[rows])


def _as_normals(latents: Latents) -> StandardNormals:
    """What no proposal moves: the latents themselves."""
    count, steps, _ = latents.noise.shape
    return StandardNormals(
        start=np.asarray(latents.start),
        noise=np.asarray(latents.noise),
        choice=np.zeros((count, steps)),
        spread_choice=np.zeros(count),
    )


def _chosen(scored: ScoredRollouts) -> IntArray:
    """Which rows, in order."""
    total = scored.rollouts.count
    count = min(MOST, math.ceil(SHARE * total))
    violating = np.flatnonzero(scored.violated)
    heaviest = np.argsort(-scored.rollouts.log_weight[violating], kind="stable")
    carrying = violating[heaviest[: (count + 1) // 2]]
    evenly = (np.arange(count - carrying.size) + 0.5) * total / max(count - carrying.size, 1)
    return np.union1d(carrying, evenly.astype(np.int64))


def _compared(problem: Problem, once: RolloutBatch, again: RolloutBatch) -> Repeats:
    """Signals are compared first: where they differ, logits have a reason to."""
    found, example = np.zeros(once.count, dtype=np.bool_), ""
    name = f"simulator {problem.simulator.name}"
    ranges = {signal.name: signal.high - signal.low for signal in problem.simulator.signals}
    for signal, values in once.signals.items():
        scale = np.maximum(np.abs(values), ranges[signal])
        same = np.abs(values - again.signals[signal]) <= ROUNDING * scale
        example = example or _first(f"{name}: {signal}", same, values, again.signals[signal])
        found |= ~same.all(axis=1)
    same = np.abs(once.pem_logit - again.pem_logit) <= LOGIT_ROUNDING
    same |= found[:, None]
    what = f"error model {problem.pem.name}: logit"
    example = example or _first(what, same, once.pem_logit, again.pem_logit)
    found |= ~same.all(axis=1)
    return Repeats(once.count, int(found.sum()), example)


def _first(what: str, same: BoolArray, values: FloatArray, others: FloatArray) -> str:
    if same.all():
        return ""
    step, row = np.argwhere(~same.T)[0].tolist()
    return f"{what} {values[row, step]:.6g} and {others[row, step]:.6g} at step {step}"
