"""Runs of subset simulation.

Au, Beck 2001, with the moves of :mod:`pemviz.sampling.subset.moves`. N rollouts follow the model;
K_l of them are at or below level l. From C_l of these, each as often as any other but for one,
Markov chains go on among the rollouts at or below the level, and all N that the chains pass are the
next. F of the last N violate::

    mu_r = (F / N) prod_l (K_l / N)

A run of its own finds the levels, each the least robust tenth of its rollouts, the C_l, and the
moves that bring most. Where the rollouts that are cut themselves choose their levels, as is usual,
mu_r is off by O(1 / N), which was a factor of 2 in 100 dimensions with N = 300. Here levels, moves
and the chains' lengths are fixed before a run begins, and mu_r has no bias at any N (Del Moral
2004, theorem 7.4.2): the next rollouts' average of a function f has the expectation
(1 / K_l) sum_k (M f)(z_k) over the K_l, where M, the average over a chain's places, depends on no
rollout of the run and keeps the model restricted to the level.
"""

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import numpy as np
from scipy.special import ndtr

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray
from pemviz.faults import SimulationError, counted_from, of_no_rollouts
from pemviz.latents import StandardNormals
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.method import VIOLATION_THRESHOLD
from pemviz.sampling.particles.runs import (
    ParticleRun,
    copies,
    in_step,
    tell_run,
)
from pemviz.sampling.problem import Problem, in_time, ranked, score
from pemviz.sampling.rollouts.runners import BatchTask, check_numbers
from pemviz.sampling.subset.moves import RandomNumbers, Shape, Tuning, moved, spreads
from pemviz.simulators.latents import latent_counts
from pemviz.types import RolloutBatch

KEPT_SHARE = 0.1
"""Of the rollouts, at or below each level (Au and Beck 2001)."""
JUST_BELOW = float(np.nextafter(VIOLATION_THRESHOLD, -1.0))
"""No level is lower: what violates would lie above it."""
MOST_LEVELS = 1_000


@dataclass(frozen=True)
class Population(Batch):
    """N rollouts of a run.

    Attributes:
        numbers: What they are made of.
        rollouts: What came of it.
        score: Robustness, below 0 exactly where the specification is violated, ``[N]``.
        ancestor: Which of the run's first rollouts each descends from, ``[N]``.
    """

    numbers: RandomNumbers
    rollouts: RolloutBatch
    score: FloatArray
    ancestor: IntArray


@dataclass(frozen=True)
class Heads(Batch):
    """Where chains are: as in :class:`Population`, and the ``row [N]`` of all simulated."""

    numbers: RandomNumbers
    score: FloatArray
    ancestor: IntArray
    row: IntArray


@dataclass(frozen=True)
class Level:
    """A level and the moves below it, as they were found before a run begins.

    Attributes:
        threshold: Rollouts are to stay at or below it.
        share: Of the rollouts, from which chains go on.
        tuning: What is known of moves.
        spread: Of each number below the level, as one row.
    """

    threshold: float
    share: float
    tuning: Tuning
    spread: RandomNumbers

    def chains(self, count: int) -> int:
        """From how many of ``count`` rollouts chains go on."""
        return max(round(self.share * count), 1)


@dataclass(frozen=True)
class Wanted:
    """Random numbers to be simulated, and how many of its rollouts a run has before them."""

    numbers: RandomNumbers
    before: int


Found = TypeVar("Found")
Simulated = tuple[RolloutBatch, FloatArray]
"""Rollouts and their scores ``[N]``."""
Going = Generator[Wanted, Simulated, Found]
"""Work as it goes: what is to be simulated, for what came of it."""


@dataclass(frozen=True)
class Finding:
    """The run that finds levels.

    Attributes:
        levels: As far as there are any, or rollouts were left.
        last: Its rollouts at or below the last of them; ``None``: too few were left to go on.
        simulated: Rollouts that it took.
    """

    levels: tuple[Level, ...]
    last: Population | None
    simulated: int

    @property
    def log_probability(self) -> float:
        """That any violates, a little off as the rollouts themselves chose the levels [nats]."""
        if self.last is None:
            return -math.inf
        below = math.fsum(math.log(level.share) for level in self.levels)
        violating = np.count_nonzero(self.last.score < VIOLATION_THRESHOLD)
        return below + math.log(violating / self.last.score.size) if violating else -math.inf


@dataclass(frozen=True)
class SubsetSimulation:
    """Runs between given levels; none: they are yet to be found.

    Attributes:
        levels: They.
    """

    levels: tuple[Level, ...] = ()
    moved_share: ClassVar[float] = KEPT_SHARE

    def most_rollouts(self, count: int) -> int:
        """What a run with ``count`` rollouts a level takes, if it reaches the last."""
        return count + sum(count - level.chains(count) for level in self.levels)

    def prepare(
        self, problem: Problem, *, count: int, generator: np.random.Generator
    ) -> "tuple[SubsetSimulation, int]":
        """With the levels that a run of ``count`` rollouts found, and what that simulated.

        Raises:
            SimulationError: Something raises, is no finite number, or a batch takes too long.
        """
        found = finding(problem, count=count, generator=generator)
        return SubsetSimulation(found.levels), found.simulated

    def carry_out(
        self, problem: Problem, *, count: int, generators: Sequence[np.random.Generator]
    ) -> Sequence[ParticleRun]:
        """Runs with ``count`` rollouts a level, one for each of ``generators``.

        Raises:
            SimulationError: Something raises, is no finite number, or a batch takes too long.
        """
        most, simulated = len(generators) * self.most_rollouts(count), 0

        def report(some: int) -> None:
            nonlocal simulated
            simulated += some
            problem.progress(count * simulated // most, count)

        return _in_step(problem, self._begun(problem, count, generators), report)

    def carry_out_beside(
        self, problem: Problem, *, count: int, generators: Sequence[np.random.Generator]
    ) -> Sequence[ParticleRun]:
        """The same beside a stage, whose rollouts these are not.

        Raises:
            SimulationError: As :meth:`carry_out`.
        """
        with of_no_rollouts():
            return _in_step(problem, self._begun(problem, count, generators), problem.searched)

    def _begun(
        self, problem: Problem, count: int, generators: Sequence[np.random.Generator]
    ) -> list[Going[ParticleRun]]:
        return [
            _run(problem, self.levels, count=count, generator=generator) for generator in generators
        ]


def finding(
    problem: Problem, *, count: int, generator: np.random.Generator, most: float = math.inf
) -> Finding:
    """A run of ``count`` rollouts a level that finds levels.

    It is cut off before it takes more than ``most`` of them.

    Raises:
        SimulationError: Something raises, is no finite number, or a batch takes too long.
    """
    with of_no_rollouts():  # of a run's that counts
        going = _finding(problem, count=count, generator=generator, most=most)
        (found,) = _in_step(problem, [going], problem.searched)
    return found


def _in_step(
    problem: Problem, going: Sequence[Going[Found]], report: Callable[[int], None]
) -> Sequence[Found]:
    """What comes of each, simulated together; ``report`` gets how many rollouts each time."""

    def answer(wanted: Mapping[int, Wanted]) -> Sequence[Simulated]:
        numbers = RandomNumbers.concatenate([each.numbers for each in wanted.values()])
        try:
            rollouts, scores = simulated_from(problem, numbers)
        except SimulationError as error:
            places = {i: (each.before, each.numbers.count) for i, each in wanted.items()}
            tell_run(error, places)
            raise
        report(numbers.count)
        ends = np.cumsum([each.numbers.count for each in wanted.values()])[:-1]
        rows = np.split(np.arange(numbers.count), ends)
        return [(rollouts.take(own), scores[own]) for own in rows]

    return in_step(going, answer)


def simulated_from(problem: Problem, numbers: RandomNumbers) -> Simulated:
    """What comes of random numbers, a batch at a time.

    Raises:
        SimulationError: Something raises, is no finite number, or a batch takes too long.
    """
    tasks, size = list[BatchTask](), problem.batch_rollouts
    for start in range(0, numbers.count, size):
        some = numbers.take(slice(start, start + size))
        normals = None
        if latent_counts(problem.simulator):
            none = np.zeros(some.noise.shape[:2])
            normals = StandardNormals(some.start, some.noise, none)
        tasks.append(BatchTask(PemProposal(), ndtr(some.outcomes), normals))
    simulated = problem.run_batches(problem.simulator, problem.pem, iter(tasks))
    parts, done = list[RolloutBatch](), 0
    for task in tasks:
        problem.pause()
        with counted_from(done, len(task.uniforms)):
            part = in_time(problem, lambda: next(simulated))
            check_numbers(part, simulator=problem.simulator.name, turns=problem.turns)
        parts.append(part)
        done += part.count
    rollouts = RolloutBatch.concatenate(parts)
    return rollouts, ranked(problem, rollouts.signals)


def simulated_beside(problem: Problem, numbers: RandomNumbers) -> RolloutBatch:
    """What comes of random numbers beside a stage, whose rollouts these are not.

    Raises:
        SimulationError: As :func:`simulated_from`.
    """
    with of_no_rollouts():
        rollouts, _ = simulated_from(problem, numbers)
    problem.searched(numbers.count)
    return rollouts


def shape_of(problem: Problem) -> Shape:
    """How many random numbers a rollout takes."""
    counts, steps = latent_counts(problem.simulator), problem.simulator.states - 1
    return Shape(steps, counts.at_start, steps // problem.turns, counts.noise, counts.seeds)


def _begun(shape: Shape, count: int, generator: np.random.Generator) -> Going[Population]:
    numbers = shape.normals(generator, count)
    rollouts, scores = yield Wanted(numbers, 0)
    return Population(numbers, rollouts, scores, np.arange(count))


def _finding(
    problem: Problem, *, count: int, generator: np.random.Generator, most: float
) -> Going[Finding]:
    """A run that finds levels and learns of moves."""
    shape, levels, simulated = shape_of(problem), list[Level](), count
    tuning = Tuning.begun(shape)
    population = yield from _begun(shape, count, generator)
    while len(levels) < MOST_LEVELS:
        below = _below_next_level(population.score)
        if below is None:
            break
        starts = population.take(np.flatnonzero(below))
        if simulated + count - starts.score.size > most:
            return Finding(tuple(levels), None, simulated)
        simulated += count - starts.score.size
        level = Level(
            threshold=max(float(starts.score.max()), JUST_BELOW),
            share=starts.score.size / count,
            tuning=tuning.at_next_level(),
            spread=spreads(starts.numbers, shape),
        )
        population, tuning = yield from _chains(
            starts, level, count=count, shape=shape, generator=generator, learns=True
        )
        levels.append(replace(level, tuning=tuning))
    return Finding(tuple(levels), population, simulated)


def _below_next_level(scores: FloatArray) -> BoolArray | None:
    """Which of ``[N]`` lie at or below the next level; ``None``: there is none that is lower.

    Nearly a tenth; of scores that are equal all do or none, whichever is nearer to it.
    """
    if np.mean(scores < VIOLATION_THRESHOLD) >= KEPT_SHARE:
        return None
    place = max(math.ceil(KEPT_SHARE * scores.size) - 1, 0)
    value = float(np.partition(scores, place)[place])
    options = [scores <= value, scores < value]
    shares = [float(option.mean()) for option in options]
    off = [abs(math.log(share / KEPT_SHARE)) if 0.0 < share < 1.0 else math.inf for share in shares]
    best = int(np.argmin(off))
    return options[best] if off[best] < math.inf else None


def _run(
    problem: Problem, levels: Sequence[Level], *, count: int, generator: np.random.Generator
) -> Going[ParticleRun]:
    """One run."""
    shape, shares, simulated = shape_of(problem), list[float](), count
    population = yield from _begun(shape, count, generator)
    for level in levels:
        below = np.flatnonzero(population.score <= level.threshold)
        shares.append(below.size / count)
        if not below.size:
            break
        chains = level.chains(count)
        simulated += count - chains
        starts = population.take(below[copies(below.size, chains, generator)])
        population, _ = yield from _chains(
            starts, level, count=count, shape=shape, generator=generator
        )
    scored = score(problem, population.rollouts)
    return ParticleRun.ended(
        scored, ancestor=population.ancestor, shares=shares, simulated=simulated
    )


def _chains(
    starts: Population,
    level: Level,
    *,
    count: int,
    shape: Shape,
    generator: np.random.Generator,
    learns: bool = False,
) -> Going[tuple[Population, Tuning]]:
    """``count`` rollouts at or below a level: those that chains start from, and all they pass.

    Chains are of equal lengths but for one; which are the longer is left to chance.

    Returns:
        They, and what was learned of moves.
    """
    tuning, done, far = level.tuning, starts.score.size, float(starts.score.std())
    current = Heads(starts.numbers, starts.score, starts.ancestor, np.arange(done))
    simulated, passed = [starts], [current.row]
    while done < count:
        if count - done < current.score.size:
            longer = generator.permutation(current.score.size)[: count - done]
            current = current.take(np.sort(longer))
        kind = tuning.chosen(current.score.size, generator)
        numbers = moved(
            current.numbers,
            kind,
            shape=shape,
            scale=tuning.scale,
            spread=level.spread,
            generator=generator,
        )
        rollouts, scores = yield Wanted(numbers, done)
        accepted = scores <= level.threshold
        if learns:
            jump = np.abs(scores - current.score)
            gain = np.where(jump > 0.0, np.minimum(jump / far if far else 1.0, 1.0), 0.0)
            tuning = tuning.learned(kind, np.where(accepted, gain, 0.0), accepted)
        simulated.append(Population(numbers, rollouts, scores, current.ancestor))
        rows = np.arange(accepted.size)
        both = Heads.concatenate([current, Heads(numbers, scores, current.ancestor, rows + done)])
        current = both.take(np.where(accepted, rows + accepted.size, rows))
        passed.append(current.row)
        done += accepted.size
    return Population.concatenate(simulated).take(np.concatenate(passed)), tuning
