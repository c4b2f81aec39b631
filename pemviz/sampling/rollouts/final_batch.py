"""The final batch: drawn in parts if it is large, of which only the weights are kept."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

from pemviz.arrays import Batch, BoolArray, FloatArray, row_sums
from pemviz.types import ScoredRollouts

LARGEST_PART = 20_000
"""Rollouts of 100 states drawn at once: about 0.1 GB with signals, memory and logits."""


@dataclass(frozen=True)
class WeighedRollouts(Batch):
    """What an estimate needs of N rollouts.

    Attributes:
        log_weight: ``[N]`` [nats].
        log_p: Log likelihood under the error model, ``[N]`` [nats].
        violated: ``[N]``.
        broken: The same of each rule by name, where there are rules.
    """

    log_weight: FloatArray
    log_p: FloatArray
    violated: BoolArray
    broken: Mapping[str, BoolArray] = field(default_factory=dict[str, BoolArray])

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return int(self.violated.size)


def weighed(scored: ScoredRollouts) -> WeighedRollouts:
    """The weights of scored rollouts."""
    return WeighedRollouts(
        log_weight=scored.rollouts.log_weight,
        log_p=row_sums(scored.rollouts.log_p),
        violated=scored.violated,
        broken=scored.broken,
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
        drawn = [replace(part, violated=part.broken[rule]) for part in self.drawn]
        return replace(self, drawn=tuple(drawn))

    def weighed(self) -> WeighedRollouts:
        """All of it.

        Raises:
            ValueError: It is not drawn yet.
        """
        if not self.is_done:
            message = "the final rollouts have not been drawn yet"
            raise ValueError(message)
        return WeighedRollouts.concatenate(self.drawn)
