"""All random numbers of rollouts, and moves that leave their distribution as it is.

A rollout is a function of independent standard normals: one for each outcome, which misses where
its normal's distribution function is below the probability of a miss, and those of its latents.
A move turns some of them towards fresh ones by an angle a that does not depend on them::

    z' = cos(a) z + sin(a) xi, xi ~ N(0, 1)

or puts some in another order. (z, z') has the density of (z', z): with any choice among moves that
does not look at z, what is accepted where z' lies in a set keeps the normal's restriction to that
set (preconditioned Crank-Nicolson: Cotter, Roberts, Stuart, White 2013; as conditional sampling in
subset simulation: Papaioannou, Betz, Zwirglmaier, Straub 2015).

Which numbers decide depends on the system: all a little, one start, what follows a certain step.
So there are many kinds of moves, and those are chosen more often that moved scores before. Latents
are mirrored too, some or all of them: what fails on one side may as well fail on the other, and no
small move leads there. As that may leave scores as they are, it has a share of its own.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Self

import numpy as np

from pemviz.arrays import AnyArray, Batch, BoolArray, FloatArray, IntArray

MOST_PLACES = 32
"""Along a rollout, at which a window of steps that is moved begins."""
EVEN_SHARE = 0.25
"""Of the moves, chosen whatever moved scores before."""
MIRRORED_SHARE = 0.1
"""Of the moves, where there are latents."""
FORGETTING = 0.8
"""Of what moved scores at a level, how much counts at the next."""
ACCEPTED = 0.44
"""Share of small moves that should be accepted (Papaioannou et al. 2015)."""
LARGEST_SCALE = 8.0


@dataclass(frozen=True)
class RandomNumbers(Batch):
    """The random numbers of N rollouts, each standard normal.

    Attributes:
        outcomes: ``[N, T-1]``.
        start: ``[N, S]``, seeds among them.
        noise: ``[N, T', M]``, of the scenario's own steps.
    """

    outcomes: FloatArray
    start: FloatArray
    noise: FloatArray

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return len(self.outcomes)

    @property
    def each(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The three arrays."""
        return self.outcomes, self.start, self.noise

    def kept(self, prefix: str) -> dict[str, AnyArray]:
        """As they are kept beside a stage."""
        return {f"{prefix}{field.name}": getattr(self, field.name) for field in fields(self)}

    @classmethod
    def of_kept(cls, kept: Mapping[str, AnyArray], prefix: str) -> Self:
        """What was kept so."""
        return cls(**{field.name: kept[f"{prefix}{field.name}"] for field in fields(cls)})


@dataclass(frozen=True)
class Shape:
    """How many numbers a rollout takes: of ``outcomes``, ``start``, ``steps`` of ``noise``.

    The last ``seeds`` of ``start`` seed random generators: a little change is a whole one.
    """

    outcomes: int
    start: int
    steps: int
    noise: int
    seeds: int = 0

    def normals(self, generator: np.random.Generator, count: int) -> RandomNumbers:
        """Of ``count`` rollouts, independent."""
        return RandomNumbers(
            outcomes=generator.standard_normal((count, self.outcomes)),
            start=generator.standard_normal((count, self.start)),
            noise=generator.standard_normal((count, self.steps, self.noise)),
        )

    @cached_property
    def places(self) -> IntArray:
        """Steps at which windows begin, ascending."""
        return np.unique(np.linspace(0, self.steps - 1, min(self.steps, MOST_PLACES)).astype(int))

    @property
    def kinds(self) -> int:
        """How many kinds of moves there are.

        All numbers but seeds a little; some starts, by any angle; and from each place on all that
        follows anew, a window by any angle, a window in another order; last, latents mirrored.
        """
        return 3 + 3 * self.places.size

    @property
    def mirrored(self) -> int:
        """Kind of the moves that mirror latents."""
        return self.kinds - 1

    @property
    def latents(self) -> bool:
        """Whether there are latents but seeds."""
        return self.start > self.seeds or self.noise > 0


@dataclass(frozen=True)
class Tuning:
    """What a run has learned of its moves.

    Attributes:
        scale: Of small moves, in spreads of the numbers.
        tried: How often each kind was, ``[K]``.
        gain: By how much it moved scores in all, ``[K]``.
        mirrors: Share of the last kind, whatever it moved.
        steps: How often ``scale`` was adapted since the level began.
    """

    scale: float
    tried: FloatArray
    gain: FloatArray
    mirrors: float
    steps: int = 0

    def kept(self, prefix: str) -> dict[str, AnyArray]:
        """As it is kept beside a stage."""
        return {
            f"{prefix}{field.name}": np.array(getattr(self, field.name)) for field in fields(self)
        }

    @classmethod
    def of_kept(cls, kept: Mapping[str, AnyArray], prefix: str) -> Self:
        """What was kept so."""
        scale, tried, gain, mirrors, steps = (
            kept[f"{prefix}{field.name}"] for field in fields(cls)
        )
        return cls(float(scale), tried, gain, float(mirrors), int(steps))

    @staticmethod
    def begun(shape: Shape) -> "Tuning":
        """Nothing is known; a kind that cannot do anything is never tried."""
        one = np.ones(shape.kinds)
        if not shape.start:
            one[1] = 0.0
        one[shape.mirrored] = 0.0
        mirrors = MIRRORED_SHARE if shape.latents else 0.0
        return Tuning(scale=0.6, tried=one, gain=one.copy(), mirrors=mirrors)

    def at_next_level(self) -> "Tuning":
        """With less of what was learned."""
        gain = np.where(self.gain > 0.0, FORGETTING * self.gain, 0.0)
        return Tuning(self.scale, np.maximum(FORGETTING * self.tried, 1.0), gain, self.mirrors)

    def chosen(self, count: int, generator: np.random.Generator) -> IntArray:
        """Kinds of the next ``count`` moves, ``[count]``."""
        able = self.gain + self.tried > 0.0
        able[-1] = False
        mean = np.where(able, self.gain / np.maximum(self.tried, 1.0), 0.0)
        share = (1.0 - EVEN_SHARE) * mean / mean.sum() + EVEN_SHARE * able / able.sum()
        share *= 1.0 - self.mirrors
        share[-1] = self.mirrors
        return generator.choice(share.size, size=count, p=share / share.sum())

    def learned(self, kind: IntArray, gain: FloatArray, accepted: BoolArray) -> "Tuning":
        """After moves ``[N]`` of kinds that moved scores by ``gain [N]``, 0 if not accepted."""
        size, scale, small = self.tried.size, self.scale, kind == 0
        if small.any():
            off = float(accepted[small].mean()) - ACCEPTED
            scale = min(scale * math.exp(off / math.sqrt(self.steps + 1.0)), LARGEST_SCALE)
        return Tuning(
            scale,
            self.tried + np.bincount(kind, minlength=size),
            self.gain + np.bincount(kind, weights=gain, minlength=size),
            self.mirrors,
            self.steps + 1,
        )


def spreads(numbers: RandomNumbers, shape: Shape) -> RandomNumbers:
    """The standard deviation of each number over N rollouts, 1 at most, as one row; of seeds 0."""
    found = numbers.map(lambda values: np.minimum(values.std(axis=0, keepdims=True), 1.0))
    found.start[:, shape.start - shape.seeds :] = 0.0
    return found


def moved(
    numbers: RandomNumbers,
    kind: IntArray,
    *,
    shape: Shape,
    scale: float,
    spread: RandomNumbers,
    generator: np.random.Generator,
) -> RandomNumbers:
    """One move of each of N rollouts' numbers, of kinds ``[N]`` as in :attr:`Shape.kinds`.

    Small moves turn each number by ``scale`` times its own ``spread``.
    """
    count, fresh = numbers.count, shape.normals(generator, numbers.count)
    window = (kind[:, None] - 2) // shape.places.size
    small, of_start, anew, reordered = kind == 0, kind == 1, window == 0, window == 2
    mirrors = kind == shape.mirrored
    steps = _windows(kind, shape, generator) & (kind[:, None] > 1) & ~mirrors[:, None]
    some = generator.random((count, shape.start)) < generator.random((count, 1))
    if shape.start:  # one of them at least
        some[np.arange(count), generator.integers(shape.start, size=count)] = True
    far = np.where(anew[:, 0], 0.5 * np.pi, generator.uniform(0.0, 2.0 * np.pi, size=count))
    turns = shape.outcomes // max(shape.steps, 1)
    numbers = _reordered(numbers, steps & reordered, turns, generator)
    steps &= ~reordered
    chosen = (np.repeat(steps, turns, axis=1), some & of_start[:, None], steps[:, :, None])
    turned: list[FloatArray] = []
    for values, new, own, block in zip(numbers.each, fresh.each, spread.each, chosen, strict=True):
        each = (count, *[1] * (values.ndim - 1))
        little = np.minimum(scale * own, 0.5 * np.pi)
        angle = np.where(small.reshape(each), little, np.where(block, far.reshape(each), 0.0))
        turned.append(np.cos(angle) * values + np.sin(angle) * new)
    found = RandomNumbers(*turned)
    return _mirrored(found, mirrors, shape, generator) if mirrors.any() else found


def _mirrored(
    numbers: RandomNumbers, rows: BoolArray, shape: Shape, generator: np.random.Generator
) -> RandomNumbers:
    """With latents of some ``rows [N]`` times -1: one in two times all, else each or not.

    The noise of all steps is one, so far.
    """
    free = shape.start - shape.seeds
    some = generator.random((numbers.count, free + shape.noise)) < 0.5
    some |= generator.random((numbers.count, 1)) < 0.5
    sign = np.where(some & rows[:, None], -1.0, 1.0)
    start = numbers.start.copy()
    start[:, :free] *= sign[:, :free]
    return RandomNumbers(numbers.outcomes, start, numbers.noise * sign[:, None, free:])


def _windows(kind: IntArray, shape: Shape, generator: np.random.Generator) -> BoolArray:
    """The steps that moves of each kind act on, ``[N, T']``: from about its place on.

    All that follows, or lengths that are even in their logarithm.
    """
    count, steps, places = kind.size, shape.steps, shape.places
    between = -(-steps // places.size)
    first = places[(kind - 2) % places.size] + generator.integers(between, size=count)
    length = np.exp(generator.uniform(0.0, math.log(steps + 1.0), size=count)).astype(np.int64)
    length = np.where((kind - 2) // places.size == 0, steps, length)[:, None]
    step, first = np.arange(steps), np.minimum(first, steps - 1)[:, None]
    return (step >= first) & (step < first + length)


def _reordered(
    numbers: RandomNumbers, window: BoolArray, turns: int, generator: np.random.Generator
) -> RandomNumbers:
    """With the steps of each rollout's ``window [N, T']`` moved on in a circle by some of them."""
    place = np.broadcast_to(np.arange(window.shape[1]), window.shape)
    length = np.maximum(window.sum(axis=1, keepdims=True), 1)
    first = np.argmax(window, axis=1)[:, None]
    by = np.floor(generator.random((len(window), 1)) * length).astype(np.int64)
    order = np.where(window, first + (place - first + by) % length, place)
    outcomes = (order[:, :, None] * turns + np.arange(turns)).reshape(len(window), -1)
    return RandomNumbers(
        np.take_along_axis(numbers.outcomes, outcomes, axis=1),
        numbers.start,
        np.take_along_axis(numbers.noise, order[:, :, None], axis=1),
    )
