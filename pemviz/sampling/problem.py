"""What a method is asked to solve: scenario, error model, specification, metric."""

import itertools
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypedDict, TypeVar

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.config import LostName
from pemviz.faults import SimulationError, counted_from
from pemviz.heartbeat import SILENT_S, StalledError, watched
from pemviz.pem.models.protocol import Pem
from pemviz.sampling.rollouts.losing import lost_at, lost_rows
from pemviz.sampling.rollouts.pooled import PooledRunner
from pemviz.sampling.rollouts.runners import (
    BatchRunner,
    BatchTask,
    check_numbers,
    run_here,
)
from pemviz.sampling.rollouts.simulate import NormalSource, of_rows
from pemviz.sampling.state.composed import (
    ChainModel,
    ComposedSimulator,
    as_member,
    with_hidden,
)
from pemviz.sampling.state.violated import Monitor
from pemviz.simulators.latents import latent_counts
from pemviz.types import (
    Proposal,
    RolloutBatch,
    SampledRollouts,
    ScoredRollouts,
    Simulator,
    StateBatch,
)

LOG = logging.getLogger(__name__)
Signals = Mapping[str, FloatArray]
Result = TypeVar("Result")
BATCH_ROLLOUTS = 4096
LARGE_BATCH_ROLLOUTS, SIDE_BY_SIDE = 512, 40
"""Who simulates so many at a time, in numpy or in SUMO, does so few of them as fast as one."""
OF_LOST = 1e-6
"""Robustness of a lost rollout is at least so far from 0, on the side that it counts on."""


@dataclass(frozen=True)
class FinishedStage:
    """What an interrupted run left of one stage.

    Attributes:
        scored: Its rollouts.
        kept: See :class:`pemviz.types.StageResult`.
        sampled: Likewise.
    """

    scored: ScoredRollouts
    kept: Mapping[str, AnyArray]
    sampled: SampledRollouts | None = None


def nothing_finished(repetition: int, stage: int) -> FinishedStage | None:  # noqa: ARG001
    """Every stage is carried out."""
    return None


def no_progress(done: int, total: int) -> None:
    """Nobody is told."""


def not_counted(count: int) -> None:
    """Nobody is told."""


def _no_pause() -> None:
    """Go on."""


def not_watched(batch: ScoredRollouts, first: int, count: int) -> None:
    """Nobody looks at rollouts before their stage is done."""


@dataclass(frozen=True)
class ScoredRule:
    """How one of several rules is scored.

    Attributes:
        robustness: Signals ``[N, T]`` to the ranking metric's scores ``[N]``.
        violated: Signals ``[N, T]`` to the Boolean verdict ``[N]``; ``None``: the score is below 0
            exactly where it is violated.
        monitor: Tells that it is broken from the states so far.
    """

    robustness: Callable[[Signals], FloatArray]
    violated: Callable[[Signals], BoolArray] | None
    monitor: Monitor


@dataclass(frozen=True)
class Problem:
    """A failure probability to be estimated.

    Attributes:
        simulator: The scenario.
        pem: The perception error model.
        robustness: Signals ``[N, T]`` to the ranking metric's scores ``[N]``.
        violated: Signals ``[N, T]`` to the Boolean verdict ``[N]``; ``None``: the score is below 0
            exactly where it is violated.
        batch_rollouts: How many rollouts are simulated between two calls of ``progress``.
        step_time_limit_s: A step of a batch that takes longer fails [s]; ``None``: no limit.
        run_batches: Who simulates the batches.
        progress: Gets after every batch how many of a stage's rollouts are done, and of how
            many; may raise to stop a run.
        searched: Gets how many rollouts were simulated beside a stage's own, of a search; may
            raise likewise.
        pause: Called now and then during long work between rollouts; may raise likewise.
        seen: Gets every batch of a stage once it is scored, which rollout of the stage its first
            one is, and how many the stage is to have.
        finished: Repetition and stage to what an interrupted run left of it; ``None``: it is
            to be carried out.
        unsafe: States ``[N]`` to whether being in one of them is what violates the
            specification, ``[N]``; ``None`` where the verdict takes more than single states.
        monitor: Tells violations from the states so far where ``unsafe`` does not.
        turns: Outcomes of a step of the scenario; each counts as a step here.
        thins: Whether of a large stage that is learned from the least robust rollouts alone are
            held, beside what is learned from.
        rules: Robustness and verdict of each rule by name, where the specification is that
            several are kept; they are scored beside it.
        conjuncts: Of the specification (``None``) and of each rule that is a conjunction, see
            :func:`pemviz.stl.conjuncts`: to violate it is to violate one of them. Methods may learn
            about each; nobody is told of them.
        lost: What a rollout counts as that could not be simulated to its end.
    """

    simulator: Simulator
    pem: Pem
    robustness: Callable[[Signals], FloatArray]
    violated: Callable[[Signals], BoolArray] | None
    batch_rollouts: int = BATCH_ROLLOUTS
    step_time_limit_s: float | None = None
    run_batches: BatchRunner = run_here
    progress: Callable[[int, int], None] = no_progress
    searched: Callable[[int], None] = not_counted
    pause: Callable[[], None] = _no_pause
    seen: Callable[[ScoredRollouts, int, int], None] = not_watched
    finished: Callable[[int, int], FinishedStage | None] = nothing_finished
    unsafe: Callable[[StateBatch], BoolArray] | None = None
    monitor: Monitor | None = None
    turns: int = 1
    thins: bool = False
    rules: Mapping[str, ScoredRule] = field(default_factory=dict[str, ScoredRule])
    conjuncts: Mapping[str | None, Sequence[ScoredRule]] = field(
        default_factory=dict[str | None, Sequence[ScoredRule]]
    )
    lost: LostName = "end"

    def without_rules(self) -> "Problem":
        """The specification alone: that all rules are kept."""
        return replace(self, rules={})

    def __post_init__(self) -> None:
        """Refuse a system whose states know what follows from another error model.

        Raises:
            ValueError: System and error model do not belong together.
        """
        own = self.pem.pem if isinstance(self.pem, ChainModel) else None
        if own is not (None if self.system is None else self.system.pem):
            message = "a system that knows its error model and the model are replaced together"
            raise ValueError(message)

    @property
    def system(self) -> ComposedSimulator | None:
        """The simulator with its components; ``None``: it is a scenario alone."""
        return self.simulator if isinstance(self.simulator, ComposedSimulator) else None

    def under(self, pem: Pem) -> "Problem":
        """The problem with another model of single outcomes, and the same hidden properties."""
        if not isinstance(self.pem, ChainModel):
            return replace(self, pem=as_member(pem, like=self.pem))
        assert self.system is not None  # noqa: S101  as it was put together
        model = with_hidden(pem, self.pem.properties)
        return replace(self, pem=model, simulator=replace(self.system, pem=pem))


def sample(
    problem: Problem,
    *,
    proposal: Proposal,
    count: int,
    seeds: np.random.SeedSequence,
    is_over: Callable[[], bool] = lambda: False,
) -> ScoredRollouts:
    """Sample and score ``count`` rollouts, in batches that do not change the result.

    Fewer, but one batch at least, if ``is_over``, which is asked after each.

    Raises:
        SimulationError: In a batch something raises, is no finite number, or takes too long.
    """
    batches = list[ScoredRollouts]()
    for batch in sample_batches(problem, proposal=proposal, count=count, seeds=seeds):
        batches.append(batch)
        if is_over():
            break
    return ScoredRollouts.concatenate(batches)


def sample_batches(
    problem: Problem,
    *,
    proposal: Proposal,
    count: int,
    seeds: np.random.SeedSequence,
) -> Iterator[ScoredRollouts]:
    """What :func:`sample` gives, batch by batch, for use where not all must be kept.

    Raises:
        SimulationError: In a batch something raises, is no finite number, or takes too long.
    """
    sizes = [
        min(problem.batch_rollouts, count - start)
        for start in range(0, count, problem.batch_rollouts)
    ]
    generator = np.random.default_rng(seeds)
    steps = problem.simulator.states - 1
    latents = NormalSource(
        seeds, counts=latent_counts(problem.simulator), steps=steps // problem.turns
    )
    starts = itertools.accumulate(sizes, initial=0)
    tasks = (
        BatchTask(
            of_rows(proposal, slice(start, start + size)),
            generator.random((size, steps)),
            latents.draw(size),
        )
        for start, size in zip(starts, sizes, strict=False)
    )
    simulated = problem.run_batches(problem.simulator, problem.pem, tasks)
    done = 0
    for size in sizes:
        began = time.perf_counter()
        with counted_from(done, size):
            rollouts = in_time(problem, lambda: next(simulated))
            check_numbers(rollouts, simulator=problem.simulator.name, turns=problem.turns)
        simulation_s = time.perf_counter() - began
        scored = score(problem, rollouts)
        robustness_s = time.perf_counter() - began - simulation_s
        timings_s = {"simulation": simulation_s, "robustness": robustness_s}
        problem.seen(scored, done, count)
        done += size
        problem.progress(done, count)
        yield replace(scored, timings_s=timings_s)


def in_time(problem: Problem, simulate: Callable[[], Result]) -> Result:
    """What ``simulate`` returns, or what it raises, while steps are done in time.

    Of rollouts that are simulated elsewhere, who has them simulated sees to it.

    Raises:
        SimulationError: There is a step that takes longer.
    """
    limit_s = problem.step_time_limit_s
    if limit_s is None or isinstance(problem.run_batches, PooledRunner):
        return simulate()
    limit, name = f"step_time_limit_s = {limit_s:g}", problem.simulator.name

    def tell() -> None:
        LOG.warning("simulator %s: a step has taken %g s so far; %s", name, SILENT_S, limit)

    try:
        return watched(simulate, limit_s=limit_s, pause=problem.pause, on_silence=tell)
    except StalledError as error:
        what = f"simulator {name}: a step took longer than {limit}"
        raise SimulationError(what, why="a run may be resumed with a larger one") from error


def side_by_side(problem: Problem) -> int:
    """Rollouts that take next to no longer than one: a few in numpy, or as many as workers."""
    size, runner = problem.batch_rollouts, problem.run_batches
    here = SIDE_BY_SIDE if size >= LARGE_BATCH_ROLLOUTS else 1
    return max(here, runner.workers) if isinstance(runner, PooledRunner) else here


def score(problem: Problem, rollouts: RolloutBatch) -> ScoredRollouts:
    """Robustness and verdict of rollouts, and those of each rule."""
    robustness, violated = judged(problem, rollouts, lost=problem.lost)
    return ScoredRollouts(
        rollouts=rollouts,
        robustness=robustness,
        violated=violated,
        **rule_scores(problem, rollouts),
    )


class RuleScores(TypedDict):
    """Of a batch's N rollouts, by rule: see :class:`pemviz.types.ScoredRollouts`."""

    rule_robustness: Mapping[str, FloatArray]
    broken: Mapping[str, BoolArray]


def rule_scores(problem: Problem, rollouts: RolloutBatch) -> RuleScores:
    """Robustness and verdict of rollouts under each rule."""
    scores = {n: judged(rule, rollouts, lost=problem.lost) for n, rule in problem.rules.items()}
    return {
        "rule_robustness": {name: robustness for name, (robustness, _) in scores.items()},
        "broken": {name: broken for name, (_, broken) in scores.items()},
    }


def ranked(problem: Problem, signals: Signals) -> FloatArray:
    """Robustness ``[N]`` that is below 0 where the specification is violated and nowhere else.

    At 0 no metric tells, and the smooth one's sign contradicts the verdict elsewhere, too: beyond a
    level that not all violations lie below, those above would not count.
    """
    robustness = problem.robustness(signals)
    if problem.violated is None:
        return robustness
    violated = problem.violated(signals)
    just_below = -np.finfo(np.float64).tiny
    return np.where(violated, np.minimum(robustness, just_below), np.maximum(robustness, 0.0))


def judged(
    by: Problem | ScoredRule, rollouts: RolloutBatch, *, lost: LostName
) -> tuple[FloatArray, BoolArray]:
    """Robustness and verdict of rollouts, ``[N]`` each; ``lost`` says what those are that broke."""
    robustness = by.robustness(rollouts.signals)
    violated = robustness < 0.0 if by.violated is None else by.violated(rollouts.signals)
    row = np.flatnonzero(lost_rows(rollouts))
    if row.size == 0:
        return robustness, violated
    counts = np.ones(row.size, dtype=np.bool_)
    if lost == "none":
        counts = violated_before(by.monitor, rollouts.take(row))
    robustness, violated = robustness.copy(), violated.copy()
    own = robustness[row]
    below, above = np.minimum(own, -OF_LOST), np.maximum(own, OF_LOST)
    robustness[row], violated[row] = np.where(counts, below, above), counts
    return robustness, violated


def violated_before(monitor: Monitor | None, rollouts: RolloutBatch) -> BoolArray:
    """Which of rollouts that are lost had violated by then, whatever came next, ``[N]``."""
    found = np.zeros(rollouts.count, dtype=np.bool_)
    if monitor is None:
        return found
    known, last = monitor.start(count=rollouts.count), lost_at(rollouts)
    for step in range(rollouts.detected.shape[1] + 1):
        signals = {name: values[:, step] for name, values in rollouts.signals.items()}
        known = monitor.advance(known, step=step, signals=signals)
        found |= (step == last) & monitor.violated(known)
    return found
