"""Violations without the errors that they do not need.

Broad proposals meet a failure mode with many misses more than it takes, or with larger errors, so
that what is met says little of what is likely in it, and hides how likely it is. Moves that leave
the model as it is, accepted where the rollout still violates, lead from there to what the model
itself does in the mode (a rejuvenation, as in resample-move: Gilks, Berzuini 2001). Here they are
chosen to lead there in few steps. A window of steps gets new random numbers; where the violation
needs it, its halves are tried instead, longest windows first (as failing input is bisected: Zeller,
Hildebrandt 2002); last all that is not needed, at once. What is left are the steps that the
violation needs, and their misses say which failure mode it is in. Where a start or a single step's
noise is needed, its numbers are turned towards new ones by half of the angle, and again as long as
that is accepted.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, ndtri

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray
from pemviz.faults import of_no_rollouts
from pemviz.sampling.problem import Problem, judged
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.subset.moves import RandomNumbers
from pemviz.sampling.subset.run import shape_of, simulated_from
from pemviz.types import RolloutBatch

NEARLY_ALL, MOST_OF_THEM, HALF = 0.8, 0.7, 0.5
"""Of the misses that one rollout needs: for another to be where it has come from, to be in its
mode, and to be where what both need is known."""
MOVES_A_HALVING, MOVES_OF_LATENTS = 2, 6
"""Of each rollout: times how often its steps can be halved; latents are turned so often at most."""
ANEW, LEAST_ANGLE = 0.5 * math.pi, math.pi / 32.0


@dataclass(frozen=True)
class Move:
    """Turns the numbers of some steps by an angle towards new ones.

    Attributes:
        first: First step; -1: where the rollout starts.
        end: The step after the last.
        angle: A right one: they are new.
        other: The other half of a window that the violation needs.
    """

    first: int
    end: int
    angle: float = ANEW
    other: "Move | None" = None

    @property
    def is_single(self) -> bool:
        """Whether it is of one step, or the start."""
        return self.end - self.first == 1 and self.first >= -1

    @property
    def is_turn(self) -> bool:
        """Whether something of the old numbers stays."""
        return self.angle != ANEW

    def next(self, *, accepted: bool, turns: bool, swaps: bool) -> "Sequence[Move]":
        """What is tried after it; single steps are turned or not, halves may swap places."""
        if accepted and self.other is not None:  # the violation needs the other half
            return self.other.parts(turns=turns, swaps=swaps)
        if accepted:
            return (self,) if self.is_turn else ()
        rest = () if self.other is None else (self.other,)
        return (*self.parts(turns=turns, swaps=swaps), *rest)

    def parts(self, *, turns: bool, swaps: bool) -> "Sequence[Move]":
        """What is tried instead."""
        if self.end - self.first > 1:
            middle = (self.first + self.end) // 2
            halves = Move(self.first, middle), Move(middle, self.end)
            one, other = halves[::-1] if swaps else halves
            return (replace(one, other=other),)
        if (turns or self.first < 0) and self.angle > LEAST_ANGLE:
            return (Move(self.first, self.end, 0.5 * self.angle),)
        return ()


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


THE_REST = Move(-2, -1)
"""All steps that are not needed, at once: of these some were missed anew, and are needed."""
RESTS = 2


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
    shape, simulated = shape_of(problem), 0
    first = [Move(-1, 0)] * (shape.start > shape.seeds) + [Move(0, shape.steps)]
    kept = rarest_violated(problem, met.rollouts)
    if needed is None:
        waiting = [list(first) for _ in range(met.count)]
        # of two modes that one rollout is in, either may stay: windows end at other steps in each
        begins = generator.integers(shape.steps, size=met.count)
        needed = np.ones((met.count, shape.steps), dtype=np.bool_)
    else:
        waiting, begins = [_stretches(row) for row in needed], np.zeros(met.count, dtype=np.int64)
        needed = needed.copy()
    rests, turned = np.zeros((2, met.count), dtype=np.int64)
    while simulated < most:
        rows = np.array([row for row, some in enumerate(waiting) if some], dtype=np.int64)
        rows = rows[: most - simulated]
        if not rows.size:
            break
        moves, before = [waiting[row].pop(0) for row in rows.tolist()], met.take(rows)
        angle = _angles(moves, begins[rows], needed[rows])
        tried = _tried(problem, before, angle, generator)
        simulated += rows.size
        accepted = _violated(problem, tried.rollouts)[np.arange(rows.size), kept[rows]]
        accepted &= ~lost_rows(tried.rollouts)
        changed = tried.rollouts.detected != before.rollouts.detected
        # a single step that is missed again tells nothing
        single = np.array([move.is_single and not move.is_turn for move in moves])
        accepted &= ~single | ~_missed_again(angle, before, tried)
        needed[rows[accepted]] &= angle[accepted, 1:] != ANEW
        place = np.arange(met.count)
        place[rows[accepted]] = met.count + np.flatnonzero(accepted)
        met = Violating.concatenate([met, tried]).take(place)
        turns, swaps = shape.noise > 0, generator.random(rows.size) < 0.5
        for number, (row, move) in enumerate(zip(rows.tolist(), moves, strict=True)):
            passed = bool(accepted[number])
            if move is THE_REST:
                rests[row] += RESTS if passed else 1
                missing = changed[number] & ~before.rollouts.detected[number]
                wanting = missing.reshape(shape.steps, -1).any(axis=1) & ~accepted[number]
                needed[row] |= wanting
                waiting[row], begins[row] = _stretches(wanting), 0
                continue
            waiting[row] += move.next(accepted=passed, turns=turns, swaps=bool(swaps[number]))
            turned[row] += move.is_turn
            if not waiting[row] and rests[row] < RESTS:
                waiting[row] = [THE_REST]
            # what is needed first, then by how much
            anew = [each for each in waiting[row] if not each.is_turn]
            turning = [each for each in waiting[row] if each.is_turn]
            waiting[row] = anew + turning if anew or turned[row] < MOVES_OF_LATENTS else []
    done = np.array([all(move.is_turn for move in some) for some in waiting])
    return Moved(met.numbers, met.rollouts, needed, done), simulated


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
    tried = _tried(problem, met.take(rows), angle, generator)
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


def _stretches(steps: BoolArray) -> list[Move]:
    """A move for each stretch of steps ``[T']`` in a row."""
    edges = np.flatnonzero(np.diff(np.pad(steps, 1).astype(np.int8)))
    return [Move(first, end) for first, end in edges.reshape(-1, 2).tolist()]


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


def _angles(moves: Sequence[Move], begins: IntArray, needed: BoolArray) -> FloatArray:
    """By which moves turn the numbers of the start and of each step, ``[N, 1 + T']``.

    Windows of each rollout begin at a step of its own, ``[N]``.
    """
    first, end, turned = np.array([(each.first, each.end, each.angle) for each in moves]).T
    step = (np.arange(needed.shape[1]) - begins[:, None]) % needed.shape[1]
    step = np.hstack([np.full((len(moves), 1), -1), step])
    within = (step >= first[:, None]) & (step < end[:, None])
    rest = np.array([move is THE_REST for move in moves])
    within[rest, 1:] = ~needed[rest]
    return np.where(within, turned[:, None], 0.0)


def _tried(
    problem: Problem, before: Violating, angle: FloatArray, generator: np.random.Generator
) -> Violating:
    """The numbers turned by angles ``[N, 1 + T']`` towards new ones, and what comes of them."""
    shape, numbers = shape_of(problem), before.numbers
    fresh = shape.normals(generator, numbers.count)
    by_step, of_start = angle[:, 1:], np.repeat(angle[:, :1], shape.start, axis=1)
    of_start[:, shape.start - shape.seeds :] = 0.0  # no proposal moves seeds
    by_outcome = np.repeat(by_step, shape.outcomes // shape.steps, axis=1)
    angles = RandomNumbers(by_outcome, of_start, by_step[:, :, None])
    turned_numbers = [
        # cos of a right angle is not 0 in float64: what is new has nothing of the old
        np.where(by == ANEW, new, np.cos(by) * known + np.sin(by) * new)
        for known, new, by in zip(numbers.each, fresh.each, angles.each, strict=True)
    ]
    turned = RandomNumbers(*turned_numbers)
    with of_no_rollouts():  # of a stage
        rollouts, _ = simulated_from(problem, turned)
    return Violating(turned, rollouts)
