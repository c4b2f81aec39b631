"""Latents of rollouts, and what their means are fitted to."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray, Rows
from pemviz.proposals.single_moves import StepsOfRollouts


class MadeWhenAsked(Protocol):
    """Monomials ``[L, B]`` of many steps, made of those alone that are asked for."""

    def __getitem__(self, rows: Rows, /) -> FloatArray:
        """Those of some steps, ``[l, B]``."""
        ...

    def take(self, rows: Rows) -> Self:
        """Some of the steps, still not made."""
        ...

    def joined(self, after: Self) -> Self:
        """These steps and more."""
        ...


@dataclass(frozen=True)
class LatentDecisions:
    """The latents of N rollouts, as proposals see them.

    Attributes:
        start: ``[N, S]``.
        rollout: Of each step with noise that may be moved, ``[L]``, ascending.
        monomials: Of the state there, ``[L, B]``; of many rollouts not at once.
        noise: ``[L, M]``.
        even: :func:`pemviz.proposals.single_moves.even_logit` there, ``[L]``.
        broken: Which rules are broken there, ``[L, R]``; ``None`` without several rules.
    """

    start: FloatArray
    rollout: IntArray
    monomials: FloatArray | MadeWhenAsked
    noise: FloatArray
    even: FloatArray
    broken: BoolArray | None = None

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return len(self.start)

    @cached_property
    def basis(self) -> FloatArray:
        """The monomials themselves, ``[L, B]``."""
        return self.monomials[:]

    @property
    def is_made(self) -> bool:
        """Whether they are in memory; else ask of few rollouts at a time."""
        return isinstance(self.monomials, np.ndarray)

    def of(self, rollouts: IntArray) -> "LatentDecisions":
        """Of the chosen rollouts, which are ascending."""
        number = np.full(self.count, -1)
        number[rollouts] = np.arange(rollouts.size)
        kept = number[self.rollout] >= 0
        return LatentDecisions(
            self.start[rollouts],
            number[self.rollout[kept]].astype(np.int64),
            self.monomials[kept],
            self.noise[kept],
            self.even[kept],
            None if self.broken is None else self.broken[kept],
        )

    def between(self, first: int, stop: int) -> "LatentDecisions":
        """Of the rollouts from ``first`` on, before ``stop``; their monomials are made."""
        steps = slice(*np.searchsorted(self.rollout, [first, stop]).tolist())
        return LatentDecisions(
            self.start[first:stop],
            self.rollout[steps] - first,
            self.monomials[steps],
            self.noise[steps],
            self.even[steps],
            None if self.broken is None else self.broken[steps],
        )

    def where(self, kept: BoolArray | None) -> "LatentDecisions":
        """Of some of the steps, ``[L]``; ``None``: of all."""
        if kept is None or kept.all():
            return self
        known = self.monomials
        some = known[kept] if isinstance(known, np.ndarray) else known.take(kept)
        return LatentDecisions(
            self.start, self.rollout[kept], some, self.noise[kept], self.even[kept]
        )

    def joined(self, after: "LatentDecisions") -> "LatentDecisions":
        """These and those of more rollouts."""
        return LatentDecisions(
            np.concatenate([self.start, after.start]),
            np.concatenate([self.rollout, after.rollout + self.count]),
            _joined(self.monomials, after.monomials),
            np.concatenate([self.noise, after.noise]),
            np.concatenate([self.even, after.even]),
            None
            if self.broken is None or after.broken is None
            else np.concatenate([self.broken, after.broken]),
        )

    @cached_property
    def steps(self) -> StepsOfRollouts:
        """Where they lie in a table of rollouts and steps."""
        return StepsOfRollouts(self.rollout, self.count)

    def by_rollout(self, values: FloatArray) -> FloatArray:
        """Sums over each rollout's steps, ``[N]`` of ``[L]``."""
        sums = np.bincount(self.rollout, weights=values, minlength=self.count)
        return sums.astype(np.float64)


def _joined(
    first: FloatArray | MadeWhenAsked, second: FloatArray | MadeWhenAsked
) -> FloatArray | MadeWhenAsked:
    if isinstance(first, np.ndarray) or isinstance(second, np.ndarray):
        return np.concatenate([first[:], second[:]])
    return first.joined(second)
