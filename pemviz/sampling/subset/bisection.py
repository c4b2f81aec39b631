"""Which of a rollout's random numbers get new ones, to find the steps that its violation needs.

A window of steps gets new random numbers; where the violation needs it, its halves are tried
instead, longest windows first (as failing input is bisected: Zeller, Hildebrandt 2002); last all
that is not needed, at once. Where a start or a single step's noise is needed, its numbers are
turned towards new ones by half of the angle, and again as long as that is accepted.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.sampling.subset.moves import RandomNumbers, Shape

MOVES_OF_LATENTS = 6
"""Of each rollout: its latents are turned so often at most."""
ANEW, LEAST_ANGLE = 0.5 * math.pi, math.pi / 32.0
HALVES_SWAPPED = 0.5
"""So often the later half of a window is tried first."""


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


THE_REST = Move(-2, -1)
"""All steps that are not needed, at once: of these some were missed anew, and are needed."""
RESTS = 2


def stretches(steps: BoolArray) -> tuple[Move, ...]:
    """A move for each stretch of steps ``[T']`` in a row."""
    edges = np.flatnonzero(np.diff(np.pad(steps, 1).astype(np.int8)))
    return tuple(Move(first, end) for first, end in edges.reshape(-1, 2).tolist())


@dataclass(frozen=True)
class Course:
    """What is still to be tried of a rollout.

    Attributes:
        waiting: Moves, the next one first; empty: none is left.
        begins: Step at which its windows begin.
        rests: How often all that is not needed was tried at once.
        turned: How often latents were turned.
    """

    waiting: tuple[Move, ...]
    begins: int = 0
    rests: int = 0
    turned: int = 0

    @property
    def move(self) -> Move:
        """The next one."""
        return self.waiting[0]

    def after(self, *, accepted: bool, turns: bool, swaps: bool) -> "Course":
        """What is left once its move was tried; see :meth:`Move.next`."""
        waiting = (*self.waiting[1:], *self.move.next(accepted=accepted, turns=turns, swaps=swaps))
        turned = self.turned + self.move.is_turn
        if not waiting and self.rests < RESTS:
            waiting = (THE_REST,)
        # what is needed first, then by how much
        anew = tuple(each for each in waiting if not each.is_turn)
        turning = tuple(each for each in waiting if each.is_turn)
        waiting = anew + turning if anew or turned < MOVES_OF_LATENTS else ()
        return replace(self, waiting=waiting, turned=turned)

    def after_the_rest(self, *, accepted: bool, wanting: BoolArray) -> "Course":
        """What is left once all that is not needed was tried; of steps ``[T']`` some may be."""
        rests = self.rests + (RESTS if accepted else 1)
        return Course(stretches(wanting), rests=rests, turned=self.turned)


@dataclass(frozen=True)
class Tries:
    """The next move of each of n rollouts.

    Attributes:
        courses: Of each.
        numbers: That it has so far.
        needed: Its steps that got no new numbers, ``[n, T']``.
        place: Which new numbers are its own, ``[n]``.
    """

    courses: Sequence[Course]
    numbers: RandomNumbers
    needed: BoolArray
    place: IntArray

    @cached_property
    def angle(self) -> FloatArray:
        """By which the numbers of the start and of each step are turned, ``[n, 1 + T']``.

        Windows of each rollout begin at a step of its own.
        """
        moves = [each.move for each in self.courses]
        begins = np.array([each.begins for each in self.courses])
        first, end, angle = np.array([(each.first, each.end, each.angle) for each in moves]).T
        step = (np.arange(self.needed.shape[1]) - begins[:, None]) % self.needed.shape[1]
        step = np.hstack([np.full((len(moves), 1), -1), step])
        within = (step >= first[:, None]) & (step < end[:, None])
        rest = np.array([move is THE_REST for move in moves])
        within[rest, 1:] = ~self.needed[rest]
        return np.where(within, angle[:, None], 0.0)

    def turned(self, shape: Shape, fresh: RandomNumbers) -> RandomNumbers:
        """The numbers that are tried, from new ones."""
        return turned(shape, self.numbers, angle=self.angle, fresh=fresh.take(self.place))

    def likely(
        self, shape: Shape, tried: RandomNumbers, generator: np.random.Generator, *, most: int
    ) -> Sequence[RandomNumbers]:
        """What may be tried after it, whichever moves are accepted, ``most`` at most.

        ``generator`` goes on as if none of the rollouts came to its end.
        """
        tries, count, found = self, len(self.courses), list[RandomNumbers]()
        while True:
            swaps = generator.random(count) < HALVES_SWAPPED
            tries = tries._either(tried, turns=shape.noise > 0, swaps=swaps)
            most -= len(tries.courses)
            if not tries.courses or most < 0:
                return found
            tried = tries.turned(shape, shape.normals(generator, count))
            found.append(tried)

    def _either(self, tried: RandomNumbers, *, turns: bool, swaps: BoolArray) -> "Tries":
        """The next moves where the present ones are accepted, and where they are not."""
        places, courses = list[int](), list[Course]()
        for accepted in (False, True):
            for place, course in enumerate(self.courses):
                if course.move is THE_REST:  # what follows, only its rollout tells
                    continue
                swapped = bool(swaps[self.place[place]])
                then = course.after(accepted=accepted, turns=turns, swaps=swapped)
                if then.waiting:
                    places.append(place + accepted * len(self.courses))
                    courses.append(then)
        place = np.array(places, dtype=np.int64)
        anew = self.needed & (self.angle[:, 1:] != ANEW)
        return Tries(
            courses,
            RandomNumbers.concatenate([self.numbers, tried]).take(place),
            np.concatenate([self.needed, anew])[place],
            np.tile(self.place, 2)[place],
        )


def turned(
    shape: Shape, numbers: RandomNumbers, *, angle: FloatArray, fresh: RandomNumbers
) -> RandomNumbers:
    """Numbers turned by angles ``[N, 1 + T']`` towards new ones."""
    by_step, of_start = angle[:, 1:], np.repeat(angle[:, :1], shape.start, axis=1)
    of_start[:, shape.start - shape.seeds :] = 0.0  # no proposal moves seeds
    by_outcome = np.repeat(by_step, shape.outcomes // shape.steps, axis=1)
    angles = RandomNumbers(by_outcome, of_start, by_step[:, :, None])
    each = [
        # cos of a right angle is not 0 in float64: what is new has nothing of the old
        np.where(by == ANEW, new, np.cos(by) * known + np.sin(by) * new)
        for known, new, by in zip(numbers.each, fresh.each, angles.each, strict=True)
    ]
    return RandomNumbers(*each)
