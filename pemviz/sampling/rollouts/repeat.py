"""Whether rollouts are the same again, and on a fast twin: some are simulated a second time.

Weights and causes take for granted that outcomes and latents decide a rollout, and that the error
model answers the same to the same state. Randomness of a simulator's own, too rare for the trial
before a run, or a model that remembers what it was asked, would make an answer wrong without a
trace: in what is drawn once it cannot be seen. The same of a twin that is another system, of which
memories of misses and what the data allow are told.
"""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.faults import of_no_rollouts
from pemviz.latents import Latents, StandardNormals
from pemviz.sampling.problem import Problem, in_time, score, side_by_side
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.rollouts.pooled import PooledRunner, Simulated
from pemviz.sampling.rollouts.runners import BatchTask
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.check import ROUNDING
from pemviz.simulators.quantised import start_cells
from pemviz.types import (
    RolloutBatch,
    ScoredRollouts,
    Simulator,
    StageResult,
    StateBatch,
    numbers_of,
)

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


@dataclass(frozen=True)
class SomeOfStage:
    """Rollouts of a stage.

    Attributes:
        stage: Zero-based.
        number: Of each in its stage, ``[N]``.
        scored: They.
    """

    stage: int
    number: IntArray
    scored: ScoredRollouts


def to_repeat(problem: Problem, stage: StageResult) -> SomeOfStage:
    """A share of a stage's rollouts, which may be none.

    Half of them are the violations that weigh most, as they carry the answer; the others lie evenly
    over the stage. Those that cannot be simulated to their end are none of them.
    """
    scored = stage.scored
    number = numbers_of(scored.rollouts.count, stage.sampled)
    if problem.lost != "end":
        whole = ~lost_rows(scored.rollouts)
        number, scored = number[whole], scored.take(whole)
    chosen = _chosen(scored)
    return SomeOfStage(stage.stage, number[chosen], scored.take(chosen))


@dataclass
class RepeatedAhead:
    """Simulates rollouts of a stage again while its last ones are under way.

    Workers that have nothing else to do wait for these, one of which may be long; to repeat
    rollouts only then is to wait for another. Which are repeated does not depend on it: what is
    certain early is begun early.

    Attributes:
        problem: What is simulated.
        under_way: What is begun, by all that decides how it goes; rollouts may be alike in that.
        violating: How many violations of the stage that is sampled are begun.
    """

    problem: Problem
    under_way: dict[bytes, list[Future[Simulated]]] = field(
        default_factory=lambda: defaultdict[bytes, list[Future[Simulated]]](list)
    )
    violating: int = 0

    def saw(self, batch: ScoredRollouts, first: int, count: int) -> None:
        """Begin some of a batch: of a stage of ``count`` rollouts, those from ``first`` on.

        None of a last batch: whatever comes next would wait for them.
        """
        runner = self._spare
        if runner is None or first + batch.rollouts.count == count:
            return
        if first == 0:
            self.violating = 0
        most = _most(count)
        evenly = _evenly(count, most)[: most // 2] - first
        rows = evenly[(evenly >= 0) & (evenly < batch.rollouts.count)]
        if not batch.rollouts.log_weight.any():  # none will weigh more than the first
            carrying = np.flatnonzero(batch.violated)[: (most + 1) // 2 - self.violating]
            self.violating += carrying.size
            rows = np.union1d(rows, carrying)
        chosen = batch.rollouts.take(rows)
        chosen = chosen.take(~lost_rows(chosen))
        for row, key in enumerate(_keys(chosen)):
            self.under_way[key].append(self._begun(runner, chosen, row))

    def again(self, rollouts: RolloutBatch) -> Iterator[RolloutBatch | None]:
        """Each rollout as it came again, once it does; those that are not under way are begun.

        ``None`` for one that is lost; nothing at all if no worker would be idle.
        """
        runner = self._spare
        if runner is None:
            return
        begun = list[Future[Simulated]]()
        for row, key in enumerate(_keys(rollouts)):
            known = self.under_way[key]
            begun.append(known.pop() if known else self._begun(runner, rollouts, row))
        yield from map(runner.answer_if_any, begun)

    @property
    def _spare(self) -> PooledRunner | None:
        runner = self.problem.run_batches
        return runner if isinstance(runner, PooledRunner) and runner.has_spare_workers else None

    def _begun(self, runner: PooledRunner, rollouts: RolloutBatch, row: int) -> Future[Simulated]:
        one = rollouts.take(slice(row, row + 1))
        task = task_of(one.detected, one.latents)
        return runner.hand_in(self.problem.simulator, self.problem.pem, task)


def repeated(
    problem: Problem,
    stages: Sequence[SomeOfStage],
    *,
    twin: Simulator | None = None,
    ahead: RepeatedAhead | None = None,
) -> Repeats:
    """Simulate rollouts of stages again, with the same outcomes and latents, all side by side.

    On a ``twin`` whose start is the simulator's, they are simulated too. What is under way
    ``ahead`` is not begun anew.

    Raises:
        SimulationError: What is simulated raises something, or takes too long.
    """
    some = [stage for stage in stages if stage.number.size]
    if not some:
        return Repeats()
    once = RolloutBatch.concatenate([stage.scored.rollouts for stage in some])
    again, found, done = _again(problem, once, ahead or RepeatedAhead(problem)), Repeats(), 0
    for stage in some:
        own = again.take(slice(done, done + stage.number.size))
        found += _of_stage(problem, stage, own, twin)
        done += own.count
    return found


def _again(problem: Problem, once: RolloutBatch, ahead: RepeatedAhead) -> RolloutBatch:
    parts, is_left = list[RolloutBatch](), np.ones(once.count, dtype=np.bool_)
    for row, came in enumerate(ahead.again(once)):
        is_left[row] = came is None
        if came is not None:
            parts.append(came)
            problem.progress(len(parts), once.count)
    left, size = once.take(is_left), max(LEAST_AT_ONCE, side_by_side(problem))
    task = task_of(left.detected, left.latents)
    tasks = [task.take(slice(first, first + size)) for first in range(0, left.count, size)]
    simulated, done = problem.run_batches(problem.simulator, problem.pem, iter(tasks)), len(parts)
    for _ in tasks:
        with of_no_rollouts():
            parts.append(in_time(problem, lambda: next(simulated)))
        done += parts[-1].count
        problem.progress(done, once.count)
    order = np.argsort(is_left, kind="stable")
    return RolloutBatch.concatenate(parts).take(np.argsort(order))


def _of_stage(
    problem: Problem, some: SomeOfStage, again: RolloutBatch, twin: Simulator | None
) -> Repeats:
    once = some.scored.rollouts
    found = _compared(problem, some, again)
    if twin is None or start_cells(twin) != start_cells(problem.simulator):
        return found
    signals = again.signals
    if twin is not problem.simulator:
        start = None if once.latents is None else once.latents.start
        signals = replay(simulator=twin, detected=once.detected, start=start)
    verdicts = score(problem.without_rules(), replace(once, signals=signals)).violated
    differing = int(np.count_nonzero(verdicts != some.scored.violated))
    return replace(found, on_twin=once.count, twin_differing=differing)


def task_of(detected: BoolArray, latents: Latents | None) -> BatchTask:
    """Rollouts with outcomes ``[N, T-1]`` that are given, and latents, if they have any."""
    normals = None if latents is None else _as_normals(latents)
    return BatchTask(_GivenOutcomes(detected), np.full(detected.shape, 0.5), normals)


def _keys(rollouts: RolloutBatch) -> list[bytes]:
    """What decides how each rollout goes."""
    latents = rollouts.latents
    deciding = [rollouts.detected, *(() if latents is None else (latents.start, latents.noise))]
    return [b"".join(values[row].tobytes() for values in deciding) for row in range(rollouts.count)]


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
    choice = np.zeros(latents.noise.shape[:2])
    return StandardNormals(start=latents.start, noise=latents.noise, choice=choice)


def _most(total: int) -> int:
    """How many of a stage."""
    return min(MOST, math.ceil(SHARE * total))


def _evenly(total: int, most: int) -> IntArray:
    """Rows of ``total``, evenly spaced; of an even number of them the first half are so too."""
    rows = ((np.arange(most) + 0.5) * total / most).astype(np.int64)
    return np.concatenate([rows[::2], rows[1::2]])


def _chosen(scored: ScoredRollouts) -> IntArray:
    """Which rows, in order."""
    most = _most(scored.rollouts.count)
    violating = np.flatnonzero(scored.violated)
    heaviest = np.argsort(-scored.rollouts.log_weight[violating], kind="stable")
    carrying = violating[heaviest[: (most + 1) // 2]]
    return np.union1d(carrying, _evenly(scored.rollouts.count, most)[: most - carrying.size])


def _compared(problem: Problem, some: SomeOfStage, again: RolloutBatch) -> Repeats:
    """Signals are compared first: where they differ, logits have a reason to."""
    once = some.scored.rollouts
    found, example = np.zeros(once.count, dtype=np.bool_), ""
    name = f"simulator {problem.simulator.name}"
    ranges = {signal.name: signal.high - signal.low for signal in problem.simulator.signals}
    for signal, values in once.signals.items():
        scale = np.maximum(np.abs(values), ranges[signal])
        same = np.abs(values - again.signals[signal]) <= ROUNDING * scale
        example = example or _first(f"{name}: {signal}", some, same, values, again.signals[signal])
        found |= ~same.all(axis=1)
    same = np.abs(once.pem_logit - again.pem_logit) <= LOGIT_ROUNDING
    same |= found[:, None]
    what = f"error model {problem.pem.name}: logit"
    example = example or _first(what, some, same, once.pem_logit, again.pem_logit)
    found |= ~same.all(axis=1)
    return Repeats(once.count, int(found.sum()), example)


def _first(
    what: str, some: SomeOfStage, same: BoolArray, values: FloatArray, others: FloatArray
) -> str:
    if same.all():
        return ""
    step, row = np.argwhere(~same.T)[0].tolist()
    where = f"at step {step} of rollout {some.number[row]} of stage {some.stage}"
    return f"{what} {values[row, step]:.6g} and {others[row, step]:.6g} {where}"
