"""Violations without the errors that they do not need.

Broad proposals meet a failure mode with many misses more than it takes, or with larger errors, so
that what is met says little of what is likely in it, and hides how likely it is. Moves that leave
the model as it is, accepted where the rollout still violates, lead from there to what the model
itself does in the mode (a rejuvenation, as in resample-move: Gilks, Berzuini 2001). Here they are
chosen to lead there in few steps. A window of steps gets new random numbers; where the violation
needs it, its halves are tried instead, longest windows first (as failing input is bisected: Zeller,
Hildebrandt 2002). Where a start or a single step's noise is needed, its numbers are turned towards
new ones by half of the angle, and again as long as that is accepted.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, ndtri

from pemviz.arrays import BoolArray, IntArray
from pemviz.faults import of_no_rollouts
from pemviz.sampling.problem import Problem, judged
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.subset.moves import RandomNumbers, Shape
from pemviz.sampling.subset.run import shape_of, simulated_from
from pemviz.types import RolloutBatch

MOVES_A_HALVING, MOVES_OF_LATENTS = 2, 6
"""Of each rollout: times how often its steps can be halved, and so many more with latents."""
ANEW, LEAST_ANGLE = 0.5 * math.pi, math.pi / 32.0


@dataclass(frozen=True)
class Move:
    """Turns the numbers of some steps by an angle towards new ones.

    Attributes:
        first: First step; -1: where the rollout starts.
        end: The step after the last.
        angle: A right one: they are new.
    """

    first: int
    end: int
    angle: float = ANEW

    def next(self, *, accepted: bool, noise: bool, swaps: bool) -> "Sequence[Move]":
        """What is tried after it, of rollouts with ``noise`` or not; halves may swap places."""
        if accepted:
            return () if self.angle == ANEW else (self,)
        if self.end - self.first > 1:
            middle = (self.first + self.end) // 2
            halves = Move(self.first, middle), Move(middle, self.end)
            return halves[::-1] if swaps else halves
        turns = (noise or self.first < 0) and self.angle > LEAST_ANGLE
        return (Move(self.first, self.end, 0.5 * self.angle),) if turns else ()


def moves_of_each(problem: Problem) -> int:
    """How many each rollout makes at most."""
    shape = shape_of(problem)
    halvings = max(1, math.ceil(math.log2(shape.steps + 1)))
    return MOVES_A_HALVING * halvings + (MOVES_OF_LATENTS if shape.latents else 0)


def rejuvenated(
    problem: Problem, rollouts: RolloutBatch, *, generator: np.random.Generator
) -> tuple[RandomNumbers, RolloutBatch, int]:
    """Violating rollouts, each moved: its numbers, what comes of them, and how many it took.

    Raises:
        SimulationError: Something raises, is no finite number, or a batch takes too long.
    """
    shape, simulated = shape_of(problem), 0
    numbers = random_numbers(rollouts, shape, generator)
    first = [Move(-1, 0)] * (shape.start > shape.seeds) + [Move(0, shape.steps)]
    kept = rarest_violated(problem, rollouts)
    waiting: list[list[Move]] = [list(first) for _ in range(numbers.count)]
    for _ in range(moves_of_each(problem)):
        rows = np.array([row for row, some in enumerate(waiting) if some], dtype=np.int64)
        if not rows.size:
            break
        tried = [waiting[row].pop(0) for row in rows.tolist()]
        moved = _moved(numbers.take(rows), tried, shape, generator)
        with of_no_rollouts():  # of a stage
            found, _ = simulated_from(problem, moved)
        simulated += rows.size
        accepted = _violated(problem, found)[np.arange(rows.size), kept[rows]] & ~lost_rows(found)
        place = np.arange(numbers.count)
        place[rows[accepted]] = numbers.count + np.flatnonzero(accepted)
        numbers = RandomNumbers.concatenate([numbers, moved]).take(place)
        rollouts = RolloutBatch.concatenate([rollouts, found]).take(place)
        swaps = generator.random(rows.size) < 0.5
        for row, move, passed, swap in zip(rows, tried, accepted, swaps, strict=True):
            noise = shape.noise > 0
            waiting[row] += move.next(accepted=bool(passed), noise=noise, swaps=bool(swap))
    return numbers, rollouts, simulated


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


def random_numbers(
    rollouts: RolloutBatch, shape: Shape, generator: np.random.Generator
) -> RandomNumbers:
    """Numbers under the error model of which rollouts, however sampled, would come."""
    miss, uniform = expit(-rollouts.pem_logit), generator.random(rollouts.detected.shape)
    below = np.where(rollouts.detected, miss + uniform * (1.0 - miss), uniform * miss)
    limits = np.finfo(np.float64)
    outcomes = ndtri(np.clip(below, limits.tiny, 1.0 - limits.epsneg))
    latents, count = rollouts.latents, rollouts.count
    if latents is None:
        return RandomNumbers(outcomes, np.empty((count, 0)), np.empty((count, shape.steps, 0)))
    return RandomNumbers(outcomes, latents.start, latents.noise)


def _moved(
    numbers: RandomNumbers, moves: Sequence[Move], shape: Shape, generator: np.random.Generator
) -> RandomNumbers:
    fresh, step = shape.normals(generator, numbers.count), np.arange(-1, shape.steps)
    first, end, turned = np.array([(each.first, each.end, each.angle) for each in moves]).T
    within = (step >= first[:, None]) & (step < end[:, None])
    angle = np.where(within, turned[:, None], 0.0)
    by_step, of_start = angle[:, 1:], np.repeat(angle[:, :1], shape.start, axis=1)
    of_start[:, shape.start - shape.seeds :] = 0.0  # no proposal moves seeds
    by_outcome = np.repeat(by_step, shape.outcomes // shape.steps, axis=1)
    angles = RandomNumbers(by_outcome, of_start, by_step[:, :, None])
    turned_numbers = [
        # cos of a right angle is not 0 in float64: what is new has nothing of the old
        np.where(by == ANEW, new, np.cos(by) * known + np.sin(by) * new)
        for known, new, by in zip(numbers.each, fresh.each, angles.each, strict=True)
    ]
    return RandomNumbers(*turned_numbers)
