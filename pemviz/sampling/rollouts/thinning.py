"""A large stage, batch by batch: the scores of all rollouts, and the least robust themselves."""

from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.drawn import Drawn
from pemviz.types import ScoredRollouts

HELD = 5_000
"""Rollouts of 100 states that are held of a stage, the least robust first: about 25 MB."""
EVEN = 1_000
"""Others that are held, evenly spaced: what views tell of all they tell from these."""
LISTED = 100
"""Least robust by each rule that are held: more than a result lists."""


def largest_held(*, states: int) -> int:
    """How many of the least robust rollouts of ``states`` states are held of a large stage."""
    return max(LISTED, HELD * 100 // states)


@dataclass(frozen=True)
class Whole:
    """The rollouts of a stage that all stay, as far as they are drawn."""

    held: tuple[ScoredRollouts, ...] = ()

    def extended(self, batch: ScoredRollouts) -> "Whole":
        """With the next rollouts."""
        return Whole((*self.held, batch))

    def done(self) -> tuple[ScoredRollouts, None]:
        """All of them."""
        return ScoredRollouts.concatenate(self.held), None


@dataclass(frozen=True)
class Thinned:
    """How far a stage is drawn.

    Attributes:
        count: How many rollouts it will have.
        most: So many of the violations and the least robust stay, beside an even sample.
        held: Those that stay so far, and later ones of which few will.
        row: Their indices.
        worst: Whether the last of ``most`` rollouts holds, and its robustness: no later one that
            is as good stays. ``None`` while there are fewer.
        robustness: Of all that are drawn, batch by batch.
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
        for robustness in (scored.robustness, *scored.rule_robustness.values()):
            stays[np.argsort(robustness, kind="stable")[:LISTED]] = True
        return np.flatnonzero(stays).astype(np.int64)

    def done(self) -> tuple[ScoredRollouts, Drawn]:
        """What stays, and what is known of all, once all are drawn."""
        settled = self.settled()
        return settled.held[0], Drawn(
            row=settled.row[0],
            every=self.every,
            robustness=np.concatenate(self.robustness),
            violated=np.concatenate(self.violated),
            log_weight=np.concatenate(self.log_weight),
        )


def least_robust(robustness: FloatArray, violated: BoolArray) -> IntArray:
    """Rollouts ``[N]``, violations first, then by robustness; ties as they were drawn."""
    return np.lexsort((robustness, ~violated)).astype(np.int64)
