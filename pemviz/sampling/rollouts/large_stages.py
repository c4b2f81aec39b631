"""Stages too large to be kept whole.

Of a final batch, sampled in parts, the violations' weights stay; of a stage that is learned from,
the scores of all rollouts and the least robust themselves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray, Rows, row_sums
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.types import RolloutBatch, SampledRollouts, ScoredRollouts, outcome_log_likelihood

LARGEST_PART = 20_000
"""Rollouts of 100 states sampled at once: about 0.1 GB with signals, memory and logits."""
HELD = 5_000
"""Rollouts of 100 states that are held of a stage, the least robust first: about 25 MB."""
EVEN = 1_000
"""Others that are held, evenly spaced: what views tell of all they tell from these."""
LISTED = 100
"""Least robust by each rule that are held: more than a result lists."""


def log_p_of(rollouts: RolloutBatch, rows: Rows) -> FloatArray:
    """Log likelihood ``[M]`` of all outcomes of chosen rollouts under the error model [nats].

    Computed for these alone, unless it is known of all.
    """
    if "log_p" in vars(rollouts):
        return row_sums(rollouts.log_p[rows])
    return row_sums(outcome_log_likelihood(rollouts.pem_logit[rows], rollouts.detected[rows]))


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
    """How many rollouts of ``states`` states are sampled at once."""
    return max(1, LARGEST_PART * 100 // states)


@dataclass(frozen=True)
class FinalBatch:
    """The parts' sizes, and weights as far as they are sampled; each is a stage of its own."""

    sizes: tuple[int, ...]
    sampled: tuple[WeighedRollouts, ...] = ()

    @property
    def next_size(self) -> int:
        """Rollouts of the next part."""
        return self.sizes[len(self.sampled)]

    @property
    def is_done(self) -> bool:
        """Whether all parts are sampled."""
        return len(self.sampled) == len(self.sizes)

    def extended(self, scored: ScoredRollouts) -> Self:
        """With one more part."""
        return replace(self, sampled=(*self.sampled, weighed(scored)))

    def under_rule(self, rule: str) -> Self:
        """The same with the verdict of one rule."""
        return replace(self, sampled=tuple(part.under_rule(rule) for part in self.sampled))

    def weighed(self) -> WeighedRollouts:
        """All of it.

        Raises:
            ValueError: It is not sampled yet.
        """
        if not self.is_done:
            message = "the final rollouts have not been sampled yet"
            raise ValueError(message)
        return WeighedRollouts.concatenate(self.sampled)


def largest_held(*, states: int) -> int:
    """How many of the least robust rollouts of ``states`` states are held of a large stage."""
    return max(LISTED, HELD * 100 // states)


@dataclass(frozen=True)
class Whole:
    """The rollouts of a stage that all stay, as far as they are sampled."""

    held: tuple[ScoredRollouts, ...] = ()

    def extended(self, batch: ScoredRollouts) -> "Whole":
        """With the next rollouts."""
        return Whole((*self.held, batch))

    def done(self) -> tuple[ScoredRollouts, None]:
        """All of them."""
        return ScoredRollouts.concatenate(self.held), None


@dataclass(frozen=True)
class Thinned:
    """How far a stage is sampled.

    Attributes:
        count: How many rollouts it will have.
        most: So many of the violations and the least robust stay, beside an even sample.
        held: Those that stay so far, and later ones of which few will.
        row: Their indices.
        worst: Whether the last of ``most`` rollouts holds, and its robustness: no later one that
            is as good stays. ``None`` while there are fewer.
        robustness: Of all that are sampled, batch by batch.
        violated: Likewise.
        log_weight: Likewise [nats].
    """

    count: int
    most: int
    held: tuple[ScoredRollouts, ...] = ()
    row: tuple[IntArray, ...] = ()
    worst: tuple[bool, float] | None = None
    robustness: tuple[FloatArray, ...] = ()
    violated: tuple[BoolArray, ...] = ()
    log_weight: tuple[FloatArray, ...] = ()

    @property
    def every(self) -> int:
        """Each so many-th rollout is held."""
        return -(-self.count // EVEN)

    def extended(self, batch: ScoredRollouts) -> "Thinned":
        """With the next rollouts."""
        first = sum(part.size for part in self.robustness)
        row = np.arange(first, first + batch.rollouts.count, dtype=np.int64)
        chosen = self._staying(batch, row)
        grown = replace(
            self,
            held=(*self.held, batch.take(chosen)),
            row=(*self.row, row[chosen]),
            robustness=(*self.robustness, batch.robustness),
            violated=(*self.violated, batch.violated),
            log_weight=(*self.log_weight, batch.rollouts.log_weight),
        )
        waiting = sum(part.size for part in grown.row[1:])
        return grown.settled() if waiting > self.most else grown

    def settled(self) -> "Thinned":
        """With those alone that stay."""
        held, row = ScoredRollouts.concatenate(self.held), np.concatenate(self.row)
        worst = None
        if row.size >= self.most:
            last = least_robust(held.robustness, held.violated)[self.most - 1]
            worst = (not held.violated[last], float(held.robustness[last]))
        chosen = replace(self, worst=None)._staying(held, row)
        return replace(self, held=(held.take(chosen),), row=(row[chosen],), worst=worst)

    def _staying(self, scored: ScoredRollouts, row: IntArray) -> IntArray:
        """Which of some rollouts may stay, ascending."""
        least = least_robust(scored.robustness, scored.violated)[: self.most]
        if self.worst is not None:
            holds, robustness = self.worst
            violated, own = scored.violated[least], scored.robustness[least]
            least = least[(violated & holds) | ((violated != holds) & (own < robustness))]
        stays = row % self.every == 0
        stays[least] = True
        stays |= lost_rows(scored.rollouts)
        for robustness in (scored.robustness, *scored.rule_robustness.values()):
            stays[np.argsort(robustness, kind="stable")[:LISTED]] = True
        return np.flatnonzero(stays).astype(np.int64)

    def done(self) -> tuple[ScoredRollouts, SampledRollouts]:
        """What stays, and what is known of all, once all are sampled."""
        settled = self.settled()
        return settled.held[0], SampledRollouts(
            row=settled.row[0],
            every=self.every,
            robustness=np.concatenate(self.robustness),
            violated=np.concatenate(self.violated),
            log_weight=np.concatenate(self.log_weight),
        )


def least_robust(robustness: FloatArray, violated: BoolArray) -> IntArray:
    """Rollouts ``[N]``, violations first, then by robustness; ties in the order of sampling."""
    return np.lexsort((robustness, ~violated)).astype(np.int64)
