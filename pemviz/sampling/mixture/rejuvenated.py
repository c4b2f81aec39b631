"""What exploration proposals have met, moved to what the error model itself does there.

They miss more often than a failure mode needs. So what they meet has next to no weight, and a
proposal fitted to it repeats the misses that are not needed, and hardly violates. Some of what a
stage has met is therefore moved (:mod:`pemviz.sampling.subset.rejuvenation`). That is no part of
the estimate; it is what proposals for such modes are fitted to
(:mod:`pemviz.sampling.mixture.explored`).

With many misses a rollout is in several modes at once, and most are in the mode that is met most.
So each is tried first without what known modes need: it is moved if it violates then.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, IntArray
from pemviz.sampling.mixture.balance_heuristic import EXPLORATION
from pemviz.sampling.problem import Problem, score
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.subset.moves import RandomNumbers
from pemviz.sampling.subset.rejuvenation import (
    Moved,
    Violating,
    modes_of,
    moves_of_each,
    rarest_violated,
    rejuvenated,
    unfinished,
    violating,
    without_known,
)
from pemviz.sampling.subset.run import simulated_beside
from pemviz.types import ScoredRollouts

SHARE = 0.2
"""Of the rollouts that are planned, so many more at most are simulated to move some."""
MOST, ROUNDS = 5, 4
"""Moved side by side; so often in the first stage that meets some, once in each later one."""
MOST_ALONE, MOST_ALONE_OF_ALL = 0.3, 0.1
"""Of what was moved to the end, or of all that was moved, that share no mode with any other."""
ENOUGH_OF_A_MODE = 4
"""To tell how they differ among themselves."""
PLACES = 2
"""Of time, in which a violation that is moved to the end may need misses."""
MOST_LOOKED_AT, MOST_TRIED = 1_000, 40
"""Of a stage's violations, and of these without what known modes need."""
SPAWN_KEY = 2**32 - 4
"""Of the children of a repetition's seed that violations are moved by."""
KEPT, SIMULATED = "moved.", "moved.simulated"


@dataclass(frozen=True)
class Rejuvenated:
    """What some of the violations have become that exploration proposals met.

    Attributes:
        moved: R rollouts; ``None``: nothing was met.
        scored: Their verdicts.
        simulated: Rollouts that it took.
        kept: What the newest stage added, for a run that goes on from it; empty: nothing.
    """

    moved: Moved | None = None
    scored: ScoredRollouts | None = None
    simulated: int = 0
    kept: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])

    @property
    def newest(self) -> int:
        """Rollouts that the newest stage's took."""
        return int(self.kept[SIMULATED]) if self.kept else 0

    @cached_property
    def modes(self) -> list[IntArray]:
        """Rows of the failure modes that are known by the misses that they need.

        None if too many are alone in theirs: then misses at other steps would do as well.
        """
        if self.moved is None:
            return []
        found = modes_of(self.moved)
        alone = sum(rows.size == 1 for rows in found)
        done = sum(rows.size for rows in found)
        most = max(MOST_ALONE * done, MOST_ALONE_OF_ALL * self.moved.count)
        return found if alone <= most else []

    @property
    def needed_misses(self) -> Sequence[BoolArray]:
        """Of each of them, those that its rollouts need, ``[n, T-1]``."""
        return [self.moved.needed_misses[rows] for rows in self.modes] if self.moved else ()

    def after(
        self,
        problem: Problem,
        newest: ScoredRollouts,
        component: IntArray,
        *,
        most: int,
        seeds: np.random.SeedSequence,
        kept: Mapping[str, AnyArray] | None,
    ) -> "Rejuvenated":
        """With some of a stage's violations.

        Args:
            problem: Whose simulator remembers violations.
            newest: The stage's rollouts.
            component: What each was sampled from, ``[n]``.
            most: Rollouts that all stages' may take.
            seeds: Of the moves.
            kept: What an interrupted run left of the stage, if it did.

        Raises:
            SimulationError: Something raises, is no finite number, or a batch takes too long.
        """
        if kept is not None:
            return self._with_kept(problem, kept)
        lost = lost_rows(newest.rollouts)
        met = np.flatnonzero(newest.violated & (component == EXPLORATION) & ~lost)
        if not met.size or most - self.simulated < moves_of_each(problem):
            return replace(self, kept={})
        generator = np.random.default_rng(seeds)
        met = generator.permutation(met)[:MOST_LOOKED_AT]
        of_which = rarest_violated(problem, newest.rollouts.take(met))
        # as many of each rule or conjunct as of any other
        place = np.sum(np.tril(of_which[:, None] == of_which), axis=1)
        met = met[np.argsort(place, kind="stable")][:MOST_TRIED]
        some = violating(problem, newest.rollouts.take(met), generator)
        moved, simulated = self._moved(
            problem, some, most=most - self.simulated, generator=generator
        )
        own: dict[str, AnyArray] = {SIMULATED: np.array(simulated)}
        if moved is not None:
            own |= moved.numbers.kept(KEPT)
            own |= {f"{KEPT}needed": moved.needed, f"{KEPT}done": moved.done}
        return self._with(problem, moved, own)

    def _moved(
        self, problem: Problem, met: Violating, *, most: int, generator: np.random.Generator
    ) -> tuple[Moved | None, int]:
        """Some of what a stage has met, and how many rollouts it took."""
        known, simulated, new, done = self.moved, 0, list[Moved](), 0
        each = moves_of_each(problem)
        for _ in range(ROUNDS if known is None else 1):
            some, needed, took = _to_move(
                problem, met, known, done=done, most=most - simulated, generator=generator
            )
            simulated += took
            few = min(MOST, some.count, (most - simulated) // each)
            if few < 1:
                break
            moved, took = rejuvenated(
                problem,
                some.take(slice(few)),
                most=min(PLACES * few * moves_of_each(problem), most - simulated),
                generator=generator,
                needed=None if needed is None else needed[:few],
            )
            simulated += took
            each = max(each, took // few)  # as few as can be moved to the end
            new.append(moved)
            known = moved if known is None else Moved.concatenate([known, moved])
            if needed is None:
                done += few
                # what is in no known mode comes once
                met = Violating.concatenate([met.take(slice(few, None)), met.take(slice(few))])
        return (Moved.concatenate(new) if new else None), simulated

    def _with_kept(self, problem: Problem, kept: Mapping[str, AnyArray]) -> "Rejuvenated":
        own = {name: values for name, values in kept.items() if name.startswith(KEPT)}
        if SIMULATED not in own:
            return replace(self, kept={})
        if f"{KEPT}needed" not in own:
            return self._with(problem, None, own)
        numbers = RandomNumbers.of_kept(own, KEPT)
        rollouts = simulated_beside(problem, numbers)
        moved = Moved(numbers, rollouts, own[f"{KEPT}needed"], own[f"{KEPT}done"])
        return self._with(problem, moved, own)

    def _with(
        self, problem: Problem, moved: Moved | None, kept: Mapping[str, AnyArray]
    ) -> "Rejuvenated":
        simulated = self.simulated + int(kept[SIMULATED])
        if moved is None:
            return replace(self, simulated=simulated, kept=kept)
        scored = score(problem, moved.rollouts)
        if self.scored is not None and self.moved is not None:
            scored = ScoredRollouts.concatenate([self.scored, scored])
            moved = Moved.concatenate([self.moved, moved])
        return Rejuvenated(moved, scored, simulated, kept)


def _to_move(
    problem: Problem,
    met: Violating,
    known: Moved | None,
    *,
    done: int,
    most: int,
    generator: np.random.Generator,
) -> tuple[Violating, BoolArray | None, int]:
    """What violates without what is known; else what was not moved to the end; else scarce modes'.

    Returns:
        It, which of its steps are left if it has been moved before, and how many it took.
    """
    if known is None:
        return met, None, 0
    unknown, took = without_known(problem, met.take(slice(most)), known=known, generator=generator)
    if not took:
        unknown = unknown.take(slice(max(met.count - done, 0)))
    if unknown.count:
        return unknown, None, took
    rest = known.take(unfinished(known))
    if rest.count:
        return Violating(rest.numbers, rest.rollouts), rest.needed, took
    modes = [rows for rows in modes_of(known) if rows.size >= ENOUGH_OF_A_MODE]
    enough = known.take(np.concatenate(modes) if modes else slice(0))
    scarce, more = without_known(
        problem, met.take(slice(most - took)), known=enough, generator=generator
    )
    return scarce, None, took + more
