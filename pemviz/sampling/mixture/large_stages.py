"""A large stage that is learned from: drawn in parts, until enough of its rollouts violate.

The pool keeps the decisions of every rollout that proposals are fitted to and that is weighed by
them, which of a very large stage would be more than memory holds. So it is drawn in parts, each
from pilots and proposals in their shares, and it is over with the part that brings its violations
to as many as are enough: later ones would teach nothing, and narrow the estimate less than final
rollouts do, of which weights alone are kept. All that were drawn count. Where violations are rare,
all that were asked for are drawn; of those that hold, the least robust join the pool, and an even
sample that stands for the others.

That a stage is over sooner where more of it violates moves its own average by less than a tenth of
its standard error: 0.4 / (p + 1) of it at most after p parts, p at least 4, which is the mean of a
normal above its middle, halved, times the difference between 1 / p and 1 / (p + 1). The unbiased
figure, the final batch's, does not move.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.drawn import Drawn
from pemviz.faults import counted_from
from pemviz.sampling.finished import FinishedStage
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.final_batch import part_sizes
from pemviz.sampling.rollouts.thinning import Thinned, Whole, least_robust
from pemviz.types import ScoredRollouts

PARTS = 4
"""In which a stage's enough violations come, if all rollouts violate."""

Part = Callable[[Problem, int, int], ScoredRollouts]
"""Draws a part of a stage: with a problem that counts progress, by its number and its size."""


@dataclass(frozen=True)
class Joining:
    """Rollouts of a stage that join the pool.

    Attributes:
        scored: They.
        row: Index in the stage of each, ascending, ``[M]``; ``None``: they are all of it.
        log_stands_for: Log of how many rollouts each stands for, ``[M]``; ``None``: for itself.
        even: Which are an even sample of the stage, ``[M]``; ``None``: all.
    """

    scored: ScoredRollouts
    row: IntArray | None = None
    log_stands_for: FloatArray | None = None
    even: BoolArray | None = None

    @property
    def sample(self) -> ScoredRollouts:
        """An even sample of the stage's rollouts, or all."""
        return self.scored if self.even is None else self.scored.take(self.even)


@dataclass(frozen=True)
class StageDrawn:
    """A stage that is drawn.

    Attributes:
        scored: Its rollouts, or those that are held.
        drawn: What is known of all, where not all are held.
        joining: Those that join the pool.
    """

    scored: ScoredRollouts
    drawn: Drawn | None
    joining: Joining

    @staticmethod
    def small(scored: ScoredRollouts) -> "StageDrawn":
        """All of them are held, and join."""
        return StageDrawn(scored, None, Joining(scored))

    @property
    def count(self) -> int:
        """How many were drawn."""
        return self.scored.rollouts.count if self.drawn is None else self.drawn.count


@dataclass(frozen=True)
class InParts:
    """How a large stage is drawn.

    Attributes:
        count: So many rollouts at most.
        enough: Violations after which it is over.
    """

    count: int
    enough: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of its parts, if all are drawn."""
        return part_sizes(self.count, largest=self._part)

    @property
    def most(self) -> int:
        """Violations that it has at most, and the least robust others join up to as many."""
        return self.enough + self._part

    @property
    def _part(self) -> int:
        return max(1, self.enough // PARTS)

    def draw(self, problem: Problem, part: Part) -> StageDrawn:
        """As many parts as it takes.

        Raises:
            SimulationError: A batch has something that is no finite number, or takes too long.
        """
        thinned, whole = Thinned(count=self.count, most=self.most), Whole()
        done = violations = 0
        for number, size in enumerate(self.sizes):
            with counted_from(done):
                scored = part(_counting_from(problem, done, of=self.count), number, size)
            thinned = thinned.extended(scored)
            if not problem.thins:
                whole = whole.extended(scored)
            done, violations = done + size, violations + int(scored.violated.sum())
            if violations >= self.enough:
                break
        held, drawn = thinned.done()
        if problem.thins:
            return StageDrawn(held, drawn, self._joining(held, drawn))
        return StageDrawn(whole.done()[0], None, self._joining(held, drawn))

    def restored(self, finished: FinishedStage) -> StageDrawn:
        """As an interrupted run left it."""
        scored, drawn = finished.scored, finished.drawn
        if drawn is not None:
            return StageDrawn(scored, drawn, self._joining(scored, drawn))
        thinned = Thinned(count=self.count, most=self.most).extended(scored)
        return StageDrawn(scored, None, self._joining(*thinned.done()))

    def _joining(self, held: ScoredRollouts, drawn: Drawn) -> Joining:
        """The least robust as they are, an even sample for the others."""
        least = np.zeros(drawn.count, dtype=np.bool_)
        least[least_robust(drawn.robustness, drawn.violated)[: self.most]] = True
        own, others = least[drawn.row], drawn.even & ~least[drawn.row]
        standing = np.zeros(drawn.row.size)
        if others.any():
            standing[others] = math.log(np.count_nonzero(~least) / np.count_nonzero(others))
        chosen = own | others
        return Joining(held.take(chosen), drawn.row[chosen], standing[chosen], drawn.even[chosen])


def _counting_from(problem: Problem, done: int, *, of: int) -> Problem:
    """The problem, whose progress is told as that of a part of a stage."""

    def progress(some: int, _: int) -> None:
        problem.progress(done + some, of)

    return replace(problem, progress=progress)
