"""What proposals sampled where it violates, resampled by its weights and moved once.

Violations may lie on all sides, as beyond a ball, and be no few modes. Proposals for parts of them
leave gaps between these, and what was never sampled shows in no weight. But what lies at the edge
of a gap has a large one. So some violations of a stage are drawn by their weights, and each makes
one move of a Markov chain that keeps the model restricted to violations (resample-move: Gilks,
Berzuini 2001; the moves are those of :mod:`pemviz.sampling.subset.moves`): into the gap, if there
is one.

What comes of it is no part of the estimate. It is what proposals for the gaps are fitted to, and
what the estimate is checked by (:mod:`pemviz.sampling.mixture.explored`). A proposal near what a
rollout became is near that rollout too, as none would be that knows nothing of it. So it has no
part in the weight of that rollout.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, IntArray, times_sampled
from pemviz.sampling.mixture.balance_heuristic import Pool, Rule
from pemviz.sampling.problem import Problem, score
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.subset.moves import RandomNumbers, Tuning, moved, spreads
from pemviz.sampling.subset.rejuvenation import violating
from pemviz.sampling.subset.run import shape_of, simulated_beside
from pemviz.types import RolloutBatch, ScoredRollouts

MOST, SHARE = 40, 0.4
"""Violations of a stage that are drawn, each for one rollout more; of its rollouts, where few."""
SPAWN_KEY = 2**32 - 5
"""Of the children of a repetition's seed that they are drawn and moved by."""
KEPT, SIMULATED = "resampled.", "resampled.simulated"


@dataclass(frozen=True)
class Resampled:
    """Violations that were drawn from those of stages, and moved.

    Attributes:
        scored: R of them, where they are now; ``None``: there are none.
        ancestor: Row in the pool of the one that each comes from, ``[R]``.
        moved: Whether each has left it, ``[R]``.
        simulated: Rollouts that it took.
        kept: What the newest stage added, for a run that goes on from it; empty: nothing.
    """

    scored: ScoredRollouts | None = None
    ancestor: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    moved: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    simulated: int = 0
    kept: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])

    @property
    def newest(self) -> int:
        """Rollouts that the newest stage's took."""
        return int(self.kept[SIMULATED]) if self.kept else 0

    @property
    def of_newest(self) -> ScoredRollouts | None:
        """What came of the newest stage's, moved or not; ``None``: nothing."""
        return self.scored.take(slice(-self.newest, None)) if self.scored and self.newest else None

    def after(
        self,
        problem: Problem,
        newest: ScoredRollouts,
        pool: Pool,
        *,
        tuning: Tuning | None,
        most: float,
        seeds: np.random.SeedSequence,
        kept: Mapping[str, AnyArray] | None,
    ) -> "Resampled":
        """With some of a stage's violations.

        Args:
            problem: Whose simulator remembers violations.
            newest: The stage's rollouts that joined the pool, its last.
            pool: All, with their weights.
            tuning: Which moves brought most where chains searched; ``None``: nothing is known.
            most: Rollouts that it may take.
            seeds: Of what is drawn and of the moves.
            kept: What an interrupted run left of the stage, if it did.

        Raises:
            SimulationError: Something raises, is no finite number, or a batch takes too long.
        """
        if kept is not None:
            return self._with_kept(problem, kept)
        generator, shape = np.random.default_rng(seeds), shape_of(problem)
        row, rules = _drawn(newest, pool, generator)
        if not row.size or row.size > most:
            return replace(self, kept={})
        some = violating(problem, newest.rollouts.take(row), generator)
        tuning = tuning or Tuning.begun(shape)
        tried = moved(
            some.numbers,
            tuning.chosen(row.size, generator),
            shape=shape,
            scale=tuning.scale,
            spread=spreads(some.numbers, shape),
            generator=generator,
        )
        rollouts = simulated_beside(problem, tried)
        accepted = _breaks(score(problem, rollouts), rules) & ~lost_rows(rollouts)
        accepted &= _differs(some.rollouts, rollouts)
        place = np.arange(row.size) + np.where(accepted, row.size, 0)
        numbers = RandomNumbers.concatenate([some.numbers, tried]).take(place)
        rollouts = RolloutBatch.concatenate([some.rollouts, rollouts]).take(place)
        own: dict[str, AnyArray] = {
            **numbers.kept(KEPT),
            SIMULATED: np.array(row.size),
            f"{KEPT}ancestor": pool.count - newest.rollouts.count + row,
            f"{KEPT}moved": accepted,
        }
        return self._with(score(problem, rollouts), own)

    def _with_kept(self, problem: Problem, kept: Mapping[str, AnyArray]) -> "Resampled":
        own = {name: values for name, values in kept.items() if name.startswith(KEPT)}
        if not own:
            return replace(self, kept={})
        rollouts = simulated_beside(problem, RandomNumbers.of_kept(own, KEPT))
        return self._with(score(problem, rollouts), own)

    def _with(self, scored: ScoredRollouts, kept: Mapping[str, AnyArray]) -> "Resampled":
        both = scored if self.scored is None else ScoredRollouts.concatenate([self.scored, scored])
        return Resampled(
            both,
            np.concatenate([self.ancestor, kept[f"{KEPT}ancestor"]]),
            np.concatenate([self.moved, kept[f"{KEPT}moved"]]),
            self.simulated + int(kept[SIMULATED]),
            kept,
        )


def _drawn(
    newest: ScoredRollouts, pool: Pool, generator: np.random.Generator
) -> tuple[IntArray, Sequence[Rule]]:
    """Rows of ``newest`` by their weights, as many that break one rule as another, and which."""
    first, kept = pool.count - newest.rollouts.count, ~lost_rows(newest.rollouts)
    rows, of_which = [np.empty(0, dtype=np.int64)], list[Rule]()
    rules = pool.rules or (None,)
    each = int(min(MOST, SHARE * newest.rollouts.count)) // len(rules)
    for rule in rules:
        own = pool if rule is None else pool.under_rule(rule)
        breaking = generator.permutation(np.flatnonzero(own.violated[first:] & kept))
        if not (breaking.size and each):
            continue
        log_weight = own.log_weight[first + breaking]
        weight = np.exp(log_weight - log_weight.max())
        drawn = np.repeat(breaking, times_sampled(weight, each))
        rows.append(drawn)
        of_which += [rule] * drawn.size
    return np.concatenate(rows), of_which


def _differs(one: RolloutBatch, other: RolloutBatch) -> BoolArray:
    """Whether each of N rollouts has outcomes or latents that its counterpart does not have."""
    found = (one.detected != other.detected).any(axis=1)
    if one.latents is not None and other.latents is not None:
        found |= (one.latents.start != other.latents.start).any(axis=1)
        found |= (one.latents.noise != other.latents.noise).any(axis=(1, 2))
    return found


def _breaks(scored: ScoredRollouts, rules: Sequence[Rule]) -> BoolArray:
    """Whether each of N rollouts still breaks the rule that it was drawn for."""
    verdicts = {rule: scored.broken[rule] if rule else scored.violated for rule in set(rules)}
    return np.array([verdicts[rule][row] for row, rule in enumerate(rules)])
