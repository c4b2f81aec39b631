"""Violations without the errors that they do not need.

Broad proposals meet a failure mode with many misses more than it takes, or with larger errors, so
that what is met says little of what is likely in it, and hides how likely it is. Moves that leave
the model as it is, accepted where the rollout still violates, lead from there to what the model
itself does in the mode (a rejuvenation, as in resample-move: Gilks, Berzuini 2001). Here they are
chosen to lead there in few steps (:mod:`pemviz.sampling.subset.bisection`). What is left are the
steps that the violation needs, and their misses say which failure mode it is in.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit, ndtri

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray
from pemviz.faults import SimulationError
from pemviz.sampling.problem import Problem, judged, side_by_side
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.subset.bisection import (
    ANEW,
    HALVES_SWAPPED,
    MOVES_OF_LATENTS,
    THE_REST,
    Course,
    Move,
    Tries,
    stretches,
    turned,
)
from pemviz.sampling.subset.moves import RandomNumbers
from pemviz.sampling.subset.run import shape_of, simulated_beside
from pemviz.types import RolloutBatch

NEARLY_ALL, MOST_OF_THEM, HALF = 0.8, 0.7, 0.5
"""Of the misses that one rollout needs: for another to be where it has come from, to be in its
mode, and to be where what both need is known."""
MOVES_A_HALVING = 2
"""Of each rollout: times how often its steps can be halved."""


@dataclass(frozen=True)
class Violating(Batch):
    """N rollouts that violate.

    Attributes:
        numbers: Random numbers under the error model of which they come.
        rollouts: They.
    """

    numbers: RandomNumbers
    rollouts: RolloutBatch

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return self.rollouts.count


@dataclass(frozen=True)
class Moved(Violating):
    """N rollouts that violate, moved.

    Attributes:
        needed: Steps that got no new numbers, as the violation needs them or some of them, or as
            they were not tried, ``[N, T']``.
        done: Whether there is nothing left to try, ``[N]``.
    """

    needed: BoolArray
    done: BoolArray

    @property
    def needed_misses(self) -> BoolArray:
        """Misses among these steps' outcomes, ``[N, T-1]``."""
        missed = ~self.rollouts.detected
        return missed & np.repeat(self.needed, missed.shape[1] // self.needed.shape[1], axis=1)


def moves_of_each(problem: Problem) -> int:
    """How many a rollout makes to find one window of steps that its violation needs."""
    shape = shape_of(problem)
    halvings = max(1, math.ceil(math.log2(shape.steps + 1)))
    return MOVES_A_HALVING * halvings + (MOVES_OF_LATENTS if shape.latents else 0)


def violating(
    problem: Problem, rollouts: RolloutBatch, generator: np.random.Generator
) -> Violating:
    """Rollouts, however sampled, with numbers under the error model of which they would come."""
    shape = shape_of(problem)
    miss, uniform = expit(-rollouts.pem_logit), generator.random(rollouts.detected.shape)
    below = np.where(rollouts.detected, miss + uniform * (1.0 - miss), uniform * miss)
    limits = np.finfo(np.float64)
    outcomes = ndtri(np.clip(below, limits.tiny, 1.0 - limits.epsneg))
    latents, count = rollouts.latents, rollouts.count
    start, noise = np.empty((count, 0)), np.empty((count, shape.steps, 0))
    if latents is not None:
        start, noise = latents.start, latents.noise
    return Violating(RandomNumbers(outcomes, start, noise), rollouts)


def rejuvenated(
    problem: Problem,
    met: Violating,
    *,
    most: int,
    generator: np.random.Generator,
    needed: BoolArray | None = None,
) -> tuple[Moved, int]:
    """Violating rollouts, each moved, and how many it took.

    Args:
        problem: Whose simulator remembers violations.
        met: What is moved.
        most: So many are simulated at most.
        generator: New numbers come from it.
        needed: What is left of the steps since they were moved before, ``[N, T']``.

    Raises:
        SimulationError: Something raises, is no finite number, or a batch takes too long.
    """
    shape, simulated, ahead = shape_of(problem), 0, _SimulatedAhead(problem)
    kept = rarest_violated(problem, met.rollouts)
    if needed is None:
        first = (Move(-1, 0),) * (shape.start > shape.seeds) + (Move(0, shape.steps),)
        # of two modes that one rollout is in, either may stay: windows end at other steps in each
        begins = generator.integers(shape.steps, size=met.count)
        courses = [Course(first, begin) for begin in begins.tolist()]
        needed = np.ones((met.count, shape.steps), dtype=np.bool_)
    else:
        courses, needed = [Course(stretches(row)) for row in needed], needed.copy()
    while simulated < most:
        rows = np.array([row for row, some in enumerate(courses) if some.waiting], dtype=np.int64)
        rows = rows[: most - simulated]
        if not rows.size:
            break
        before, place = met.take(rows), np.arange(rows.size)
        tries = Tries([courses[row] for row in rows.tolist()], before.numbers, needed[rows], place)
        numbers = tries.turned(shape, shape.normals(generator, rows.size))
        tried = ahead.tried(tries, numbers, generator)
        simulated += rows.size
        accepted = _violated(problem, tried.rollouts)[place, kept[rows]]
        accepted &= ~lost_rows(tried.rollouts)
        changed = tried.rollouts.detected != before.rollouts.detected
        # a single step that is missed again tells nothing
        single = np.array([each.move.is_single and not each.move.is_turn for each in tries.courses])
        accepted &= ~single | ~_missed_again(tries.angle, before, tried)
        needed[rows[accepted]] &= tries.angle[accepted, 1:] != ANEW
        place = np.arange(met.count)
        place[rows[accepted]] = met.count + np.flatnonzero(accepted)
        met = Violating.concatenate([met, tried]).take(place)
        swaps = generator.random(rows.size) < HALVES_SWAPPED
        for number, (row, course) in enumerate(zip(rows.tolist(), tries.courses, strict=True)):
            passed = bool(accepted[number])
            if course.move is THE_REST:
                missing = changed[number] & ~before.rollouts.detected[number]
                wanting = missing.reshape(shape.steps, -1).any(axis=1) & ~accepted[number]
                needed[row] |= wanting
                courses[row] = course.after_the_rest(accepted=passed, wanting=wanting)
                continue
            swapped = bool(swaps[number])
            courses[row] = course.after(accepted=passed, turns=shape.noise > 0, swaps=swapped)
    done = np.array([all(move.is_turn for move in some.waiting) for some in courses])
    return Moved(met.numbers, met.rollouts, needed, done), simulated


@dataclass
class _SimulatedAhead:
    """What comes of moves, with those that may be tried next where they cost no time.

    They come one after the other, and would leave most of many workers idle. What is never asked
    for changes nothing, is no part of any count, and ends no run.
    """

    problem: Problem
    rollouts: RolloutBatch | None = field(default=None, init=False)
    place: Mapping[bytes, int] = field(default_factory=dict[bytes, int], init=False)

    def __post_init__(self) -> None:
        self._most = side_by_side(self.problem)

    def tried(
        self, tries: Tries, wanted: RandomNumbers, generator: np.random.Generator
    ) -> Violating:
        """What comes of moves' numbers; ``generator`` gave these, and stays as it is.

        Raises:
            SimulationError: Something raises, is no finite number, or a batch takes too long.
        """
        keys = _keys(wanted)
        if self.rollouts is None or any(key not in self.place for key in keys):
            shape, generator = shape_of(self.problem), copy.deepcopy(generator)
            likely = tries.likely(shape, wanted, generator, most=self._most - wanted.count)
            numbers = RandomNumbers.concatenate([wanted, *likely])
            try:
                self.rollouts = simulated_beside(self.problem, numbers)
            except SimulationError:
                if not likely:
                    raise
                numbers, self._most = wanted, 0
                self.rollouts = simulated_beside(self.problem, numbers)
            self.place = {key: place for place, key in enumerate(_keys(numbers))}
        place = np.array([self.place[key] for key in keys])
        return Violating(wanted, self.rollouts.take(place))


def _keys(numbers: RandomNumbers) -> list[bytes]:
    """What tells rollouts apart."""
    rows = np.hstack([values.reshape(numbers.count, -1) for values in numbers.each])
    return [row.tobytes() for row in rows]


def without_known(
    problem: Problem, met: Violating, *, known: Moved, generator: np.random.Generator
) -> tuple[Violating, int]:
    """Those that violate with new numbers at the steps that known modes need, and how many it took.

    A rollout is in a known mode if it has most of the misses that the mode needs; one that is in
    none stays as it is.

    Args:
        problem: Whose simulator remembers violations.
        met: Rollouts that violate.
        known: What was moved before.
        generator: New numbers come from it.

    Raises:
        SimulationError: Something raises, is no finite number, or a batch takes too long.
    """
    misses = known.needed_misses * 1.0
    shared = ~met.rollouts.detected @ misses.T
    in_mode = shared >= MOST_OF_THEM * misses.sum(axis=1)
    renewed = (in_mode[:, :, None] & known.needed).any(axis=1)
    rows = np.flatnonzero(renewed.any(axis=1))
    if not rows.size:
        return met, 0
    angle = np.where(np.pad(renewed[rows], ((0, 0), (1, 0))), ANEW, 0.0)
    shape, some = shape_of(problem), met.numbers.take(rows)
    numbers = turned(shape, some, angle=angle, fresh=shape.normals(generator, some.count))
    tried = Violating(numbers, simulated_beside(problem, numbers))
    place = np.arange(met.count)
    place[rows] = met.count + np.arange(rows.size)
    met = Violating.concatenate([met, tried]).take(place)
    violates = _violated(problem, met.rollouts).any(axis=1) & ~lost_rows(met.rollouts)
    return met.take(violates), int(rows.size)


def unfinished(moved: Moved) -> IntArray:
    """Rows that were not moved to the end, nor is another that needs hardly any other steps."""
    steps = moved.needed * 1.0
    size = steps.sum(axis=1)
    within = steps @ steps.T >= NEARLY_ALL * size[:, None]  # of what the row needs, the column has
    within &= (size[:, None] < size) | np.tri(moved.count, k=-1, dtype=np.bool_)
    return np.flatnonzero(~moved.done & ~within.any(axis=0)).astype(np.int64)


def modes_of(moved: Moved) -> list[IntArray]:
    """Rows of each failure mode that needs misses: those with half of the fewer ones in common.

    Those that were not moved to the end may seem to be in several; without others each is its own.
    """
    misses = moved.needed_misses * 1.0
    size, shared = misses.sum(axis=1), misses @ misses.T
    known = (size > 0.0) & (moved.done | ~moved.done.any())
    alike = (shared >= HALF * np.minimum(size, size[:, None])) & moved.done & moved.done[:, None]
    np.fill_diagonal(alike, val=True)
    mode = np.arange(size.size)
    for _ in range(size.size):  # until nothing alike is of another mode
        mode = np.where(alike, mode, size.size).min(axis=1)
    found = [np.flatnonzero(known & (mode == number)) for number in np.unique(mode[known])]
    return [rows.astype(np.int64) for rows in found]


def _violated(problem: Problem, rollouts: RolloutBatch) -> BoolArray:
    """Whether rollouts violate each conjunct of the specification, or of each rule, ``[N, K]``.

    A mode of one that is violated seldom must not be left for that of another.
    """
    named = problem.rules if len(problem.rules) > 1 else {None: problem}
    each = [problem.conjuncts.get(rule) or (whole,) for rule, whole in named.items()]
    verdicts = [judged(one, rollouts, lost=problem.lost)[1] for some in each for one in some]
    return np.stack(verdicts, axis=1)


def rarest_violated(problem: Problem, rollouts: RolloutBatch) -> IntArray:
    """Number of the conjunct that each violates, of several the one that the fewest do, ``[N]``.

    Of the specification, or of each rule.
    """
    violated = _violated(problem, rollouts)
    count = np.where(violated, violated.sum(axis=0), violated.shape[0] + 1)
    return count.argmin(axis=1)


def _missed_again(angle: FloatArray, before: Violating, tried: Violating) -> BoolArray:
    """Whether a step that got new numbers is missed as it was, ``[N]``."""
    again = ~before.rollouts.detected & ~tried.rollouts.detected
    by_step = again.reshape(len(again), angle.shape[1] - 1, -1).any(axis=2)
    return (by_step & (angle[:, 1:] != 0.0)).any(axis=1)
