"""What exploration proposals have met, moved to what the error model itself does there.

They miss more often than a failure mode needs. So what they meet has next to no weight, and a
proposal fitted to it repeats the misses that are not needed, and hardly violates. Some of what a
stage has met is therefore moved (:mod:`pemviz.sampling.subset.rejuvenation`). That is no part of
the estimate; it is what proposals for such modes are fitted to
(:mod:`pemviz.sampling.mixture.explored`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pemviz.arrays import AnyArray, IntArray
from pemviz.faults import of_no_rollouts
from pemviz.sampling.mixture.balance_heuristic import EXPLORATION
from pemviz.sampling.problem import Problem, score
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.subset.moves import RandomNumbers
from pemviz.sampling.subset.rejuvenation import moves_of_each, rarest_violated, rejuvenated
from pemviz.sampling.subset.run import simulated_from
from pemviz.types import ScoredRollouts

SHARE = 0.2
"""Of the rollouts that are planned, so many more at most are simulated to move some."""
MOST, FEWEST = 10, 4
"""Of a stage's violations; after the first stage it is not worth waiting for fewer."""
MOST_LOOKED_AT = 1_000
"""Of a stage's violations, among which these are chosen."""
SPAWN_KEY = 2**32 - 4
"""Of the children of a repetition's seed that violations are moved by."""
KEPT, SIMULATED = "moved.", "moved.simulated"
NUMBERS = "outcomes", "start", "noise"


@dataclass(frozen=True)
class Rejuvenated:
    """What some of the violations have become that exploration proposals met.

    Attributes:
        scored: R rollouts; ``None``: nothing was met.
        simulated: Rollouts that it took.
        kept: What the newest stage added, for a run that goes on from it; empty: nothing.
    """

    scored: ScoredRollouts | None = None
    simulated: int = 0
    kept: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])

    @property
    def newest(self) -> int:
        """Rollouts that the newest stage's took."""
        return int(self.kept[SIMULATED]) if self.kept else 0

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
        if kept is not None and SIMULATED not in kept:
            return Rejuvenated(self.scored, self.simulated)
        if kept is not None:
            arrays = {name: kept[f"{KEPT}{name}"] for name in NUMBERS}
            with of_no_rollouts():  # of the stage
                rollouts, _ = simulated_from(problem, RandomNumbers(**arrays))
            own = {name: values for name, values in kept.items() if name.startswith(KEPT)}
            return self._with(score(problem, rollouts), int(kept[SIMULATED]), own)
        lost = lost_rows(newest.rollouts)
        met = np.flatnonzero(newest.violated & (component == EXPLORATION) & ~lost)
        left = most - self.simulated
        few = min(MOST, left // moves_of_each(problem), met.size)
        if few < (FEWEST if self.simulated else 1):
            return Rejuvenated(self.scored, self.simulated)
        generator = np.random.default_rng(seeds)
        met = generator.permutation(met)[:MOST_LOOKED_AT]
        of_which = rarest_violated(problem, newest.rollouts.take(met))
        # as many of each rule or conjunct as of any other
        place = np.sum(np.tril(of_which[:, None] == of_which), axis=1)
        some = np.sort(met[np.argsort(place, kind="stable")[:few]])
        numbers, rollouts, simulated = rejuvenated(
            problem, newest.rollouts.take(some), generator=generator
        )
        own = {f"{KEPT}{name}": getattr(numbers, name) for name in NUMBERS}
        own[SIMULATED] = np.array(simulated)
        return self._with(score(problem, rollouts), simulated, own)

    def _with(
        self, scored: ScoredRollouts, simulated: int, kept: Mapping[str, AnyArray]
    ) -> "Rejuvenated":
        if self.scored is not None:
            scored = ScoredRollouts.concatenate([self.scored, scored])
        return Rejuvenated(scored, self.simulated + simulated, kept)
