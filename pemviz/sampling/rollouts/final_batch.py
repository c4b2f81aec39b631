"""The final batch: drawn in parts if it is large, of which the violations' weights are kept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.sampling.rollouts.likelihoods import log_p_of
from pemviz.types import ScoredRollouts

LARGEST_PART = 20_000
"""Rollouts of 100 states drawn at once: about 0.1 GB with signals, memory and logits."""


@dataclass(frozen=True)
class WeighedRollouts:
    """What an estimate needs of N rollouts: their number, and the F that violate.

    Attributes:
        count: N.
        row: Which of them violate, ``[F]``, ascending.
        log_weight: Of these, ``[F]`` [nats].
        log_p: Log likelihood of these under the error model, ``[F]`` [nats].
        broken: Which of these violate each rule, ``[F]`` by name, where there are rules.
    """

    count: int
    row: IntArray
    log_weight: FloatArray
    log_p: FloatArray
    broken: Mapping[str, BoolArray] = field(default_factory=dict[str, BoolArray])

    @property
    def failures(self) -> int:
        """How many violate, F."""
        return int(self.row.size)

    def under_rule(self, rule: str) -> Self:
        """The same rollouts, of which those violate that break one rule."""
        chosen = self.broken[rule]
        return replace(
            self,
            row=self.row[chosen],
            log_weight=self.log_weight[chosen],
            log_p=self.log_p[chosen],
            broken={name: broken[chosen] for name, broken in self.broken.items()},
        )

    @staticmethod
    def concatenate(parts: "Sequence[WeighedRollouts]") -> "WeighedRollouts":
        """All of at least one part, in order."""
        counts = [part.count for part in parts]
        firsts = np.cumsum([0, *counts], dtype=np.int64)[:-1]
        rows = [part.row + first for part, first in zip(parts, firsts, strict=True)]
        return WeighedRollouts(
            count=sum(counts),
            row=np.concatenate(rows),
            log_weight=np.concatenate([part.log_weight for part in parts]),
            log_p=np.concatenate([part.log_p for part in parts]),
            broken={n: np.concatenate([p.broken[n] for p in parts]) for n in parts[0].broken},
        )


def weighed(scored: ScoredRollouts) -> WeighedRollouts:
    """The weights of scored rollouts."""
    row, rollouts = np.flatnonzero(scored.violated), scored.rollouts
    return WeighedRollouts(
        count=rollouts.count,
        row=row,
        log_weight=rollouts.log_weight[row] if row.size else np.empty(0),
        log_p=log_p_of(rollouts, row),
        broken={name: broken[row] for name, broken in scored.broken.items()},
    )


def part_sizes(count: int, *, largest: int) -> tuple[int, ...]:
    """``count`` in as few parts as ``largest`` allows, their sizes at most one apart."""
    parts = -(-count // largest)
    size, rest = divmod(count, parts)
    return tuple(size + (part < rest) for part in range(parts))


def largest_part(*, states: int) -> int:
    """How many rollouts of ``states`` states are drawn at once."""
    return max(1, LARGEST_PART * 100 // states)


@dataclass(frozen=True)
class FinalBatch:
    """How far the final batch is drawn; each part is a stage of its own.

    Attributes:
        sizes: Of the parts.
        drawn: Their weights, as far as they are drawn.
    """

    sizes: tuple[int, ...]
    drawn: tuple[WeighedRollouts, ...] = ()

    @property
    def next_size(self) -> int:
        """Rollouts of the next part."""
        return self.sizes[len(self.drawn)]

    @property
    def is_done(self) -> bool:
        """Whether all parts are drawn."""
        return len(self.drawn) == len(self.sizes)

    def extended(self, scored: ScoredRollouts) -> Self:
        """With one more part."""
        return replace(self, drawn=(*self.drawn, weighed(scored)))

    def under_rule(self, rule: str) -> Self:
        """The same with the verdict of one rule."""
        return replace(self, drawn=tuple(part.under_rule(rule) for part in self.drawn))

    def weighed(self) -> WeighedRollouts:
        """All of it.

        Raises:
            ValueError: It is not drawn yet.
        """
        if not self.is_done:
            message = "the final rollouts have not been drawn yet"
            raise ValueError(message)
        return WeighedRollouts.concatenate(self.drawn)
