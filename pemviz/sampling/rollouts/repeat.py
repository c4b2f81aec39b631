"""Whether rollouts are the same again, and on a fast twin: some are simulated a second time.

Weights and causes take for granted that outcomes and latents decide a rollout, and that the error
model answers the same to the same state. Randomness of a simulator's own, too rare for the trial
before a run, or a model that remembers what it was asked, would make an answer wrong without a
trace: in what is drawn once it cannot be seen. The same of a twin that is another system, of which
memories of misses and what the data allow are told.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.faults import of_no_rollouts
from pemviz.latents import Latents, StandardNormals
from pemviz.sampling.problem import Problem, in_time, score, side_by_side
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.rollouts.runners import BatchTask
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.check import ROUNDING
from pemviz.simulators.quantised import start_cells
from pemviz.types import RolloutBatch, ScoredRollouts, Simulator, StateBatch

SHARE = 0.02
"""Of a stage's rollouts."""
MOST = 32
"""Of a stage: what happens in one of ten rollouts is then found in 97 % of stages."""
LEAST_AT_ONCE = 5
LOGIT_ROUNDING = 1e-3
"""What a logit may differ by: networks in single precision round as their batch is laid out."""


@dataclass(frozen=True)
class Repeats:
    """Rollouts that were simulated a second time.

    Attributes:
        count: How many.
        differing: How many of them went otherwise.
        example: What differed in the first of these, in words; empty if none did.
        on_twin: How many were simulated on a twin too.
        twin_differing: Of how many of these the verdict is another there.
    """

    count: int = 0
    differing: int = 0
    example: str = ""
    on_twin: int = 0
    twin_differing: int = 0

    def __add__(self, other: "Repeats") -> "Repeats":
        return Repeats(
            self.count + other.count,
            self.differing + other.differing,
            self.example or other.example,
            self.on_twin + other.on_twin,
            self.twin_differing + other.twin_differing,
        )


def to_repeat(problem: Problem, scored: ScoredRollouts) -> ScoredRollouts:
    """A share of a stage's rollouts, which may be none.

    Half of them are the violations that weigh most, as they carry the answer; the others lie evenly
    over the stage. Those that cannot be simulated to their end are none of them.
    """
    scored = scored.take(~lost_rows(scored.rollouts)) if problem.lost != "end" else scored
    return scored.take(_chosen(scored))


def repeated(
    problem: Problem, stages: Sequence[ScoredRollouts], *, twin: Simulator | None = None
) -> Repeats:
    """Simulate rollouts of stages again, with the same outcomes and latents, all side by side.

    On a ``twin`` whose start is the simulator's, they are simulated too.

    Raises:
        SimulationError: What is simulated raises something, or takes too long.
    """
    some = [stage for stage in stages if stage.rollouts.count]
    if not some:
        return Repeats()
    detected = np.concatenate([stage.rollouts.detected for stage in some])
    latents = [stage.rollouts.latents for stage in some]
    task = task_of(detected, [each for each in latents if each is not None])
    size = max(LEAST_AT_ONCE, side_by_side(problem))
    tasks = [task.take(slice(first, first + size)) for first in range(0, len(detected), size)]
    simulated = problem.run_batches(problem.simulator, problem.pem, iter(tasks))
    parts, done = list[RolloutBatch](), 0
    for _ in tasks:
        with of_no_rollouts():
            parts.append(in_time(problem, lambda: next(simulated)))
        done += parts[-1].count
        problem.progress(done, len(detected))
    again, found, done = RolloutBatch.concatenate(parts), Repeats(), 0
    for stage in some:
        own = again.take(slice(done, done + stage.rollouts.count))
        found += _of_stage(problem, stage, own, twin)
        done += own.count
    return found


def _of_stage(
    problem: Problem, some: ScoredRollouts, again: RolloutBatch, twin: Simulator | None
) -> Repeats:
    once = some.rollouts
    found = _compared(problem, once, again)
    if twin is None or start_cells(twin) != start_cells(problem.simulator):
        return found
    signals = again.signals
    if twin is not problem.simulator:
        start = None if once.latents is None else once.latents.start
        signals = replay(simulator=twin, detected=once.detected, start=start)
    verdicts = score(problem.without_rules(), replace(once, signals=signals)).violated
    differing = int(np.count_nonzero(verdicts != some.violated))
    return replace(found, on_twin=once.count, twin_differing=differing)


def task_of(detected: BoolArray, latents: Sequence[Latents]) -> BatchTask:
    """Rollouts with outcomes ``[N, T-1]`` that are given, and latents, if they have any."""
    normals = _as_normals(latents) if latents else None
    return BatchTask(_GivenOutcomes(detected), np.full(detected.shape, 0.5), normals)


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


def _as_normals(latents: Sequence[Latents]) -> StandardNormals:
    """What no proposal moves: the latents themselves."""
    noise = np.concatenate([each.noise for each in latents])
    return StandardNormals(
        start=np.concatenate([each.start for each in latents]),
        noise=noise,
        choice=np.zeros(noise.shape[:2]),
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
