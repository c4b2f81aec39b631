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

Of some systems what chains pass on their way down to violations leads to hardly any: a pole that
leans far either has fallen already, or comes back. There the levels' chains find nothing, or what
descends from one rollout, and one move leads hardly away from what proposals know. So most of what
was moved stays, and makes several moves at every stage: chains that begin where it violates, and
are as long as the run learns.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, IntArray, times_sampled
from pemviz.sampling.mixture.balance_heuristic import Pool, Rule
from pemviz.sampling.problem import Problem, score
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.subset.moves import RandomNumbers, Tuning, moved, spreads
from pemviz.sampling.subset.rejuvenation import Violating, violating
from pemviz.sampling.subset.run import shape_of, simulated_beside
from pemviz.types import RolloutBatch, ScoredRollouts

MOST, SHARE = 40, 0.4
"""Violations of a stage that are drawn, each for one rollout more; of its rollouts, where few."""
STAYING, MOVES = 0.8, 6
"""Where levels' chains hardly find any: share of those that were moved that stay, and moves of each
at a stage. Of a pole that starts anywhere eight of 40 intervals did not hold without; three do not
with these."""
SPAWN_KEY = 2**32 - 5
"""Of the children of a repetition's seed that they are drawn and moved by."""
KEPT, SIMULATED, ANCESTOR = "resampled.", "resampled.simulated", "resampled.ancestor"


@dataclass(frozen=True, eq=False)
class _Heads:
    """H violations that are moved.

    Attributes:
        rollouts: They.
        ancestor: Row in the pool of the one that each comes from, ``[H]``.
        moved: Whether each has left it, ``[H]``.
        rules: Which each is to break.
    """

    rollouts: RolloutBatch
    ancestor: IntArray
    moved: BoolArray
    rules: Sequence[Rule]


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
        if self.scored is None or not self.kept:
            return None
        return self.scored.take(slice(-self.kept[ANCESTOR].size, None))

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
        moves: int = 1,
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
            moves: Of each, where so many are left; of several, most of what was moved stays.

        Raises:
            SimulationError: Something raises, is no finite number, or a batch takes too long.
        """
        if kept is not None:
            return self._with_kept(problem, kept)
        generator = np.random.default_rng(seeds)
        heads = self._heads(newest, pool, generator, share=STAYING if moves > 1 else 0.0)
        moves = int(min(moves, most / max(heads.moved.size, 1)))
        if not (heads.moved.size and moves):
            return replace(self, kept={})
        tuning, left = tuning or Tuning.begun(shape_of(problem)), heads.moved
        some = violating(problem, heads.rollouts, generator)
        for _ in range(moves):
            some, accepted = _moved(problem, some, heads.rules, tuning, generator)
            left = left | accepted
        own: dict[str, AnyArray] = {
            **some.numbers.kept(KEPT),
            SIMULATED: np.array(moves * some.count),
            ANCESTOR: heads.ancestor,
            f"{KEPT}moved": left,
        }
        return self._with(score(problem, some.rollouts), own)

    def _heads(
        self, newest: ScoredRollouts, pool: Pool, generator: np.random.Generator, *, share: float
    ) -> _Heads:
        """Those of ``newest`` that are drawn; in place of a share of them, some that were moved."""
        row, rules = _drawn(newest, pool, generator)
        rollouts, ancestor = newest.rollouts.take(row), pool.count - newest.rollouts.count + row
        drawn = _Heads(rollouts, ancestor, np.zeros(row.size, dtype=np.bool_), rules)
        before = self.of_newest
        if before is None or not share:
            return drawn
        count, own = before.rollouts.count, np.arange(row.size)
        places = generator.permutation(row.size)[: int(share * row.size)]
        for rule in dict.fromkeys(rules):
            theirs = places[[rules[place] == rule for place in places]]
            stays = generator.permutation(np.flatnonzero(_breaking(before, rule)))[: theirs.size]
            own[theirs[: stays.size]] = row.size + stays
        return _Heads(
            RolloutBatch.concatenate([rollouts, before.rollouts]).take(own),
            np.concatenate([ancestor, self.ancestor[-count:]])[own],
            np.concatenate([drawn.moved, self.moved[-count:]])[own],
            rules,
        )

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
            np.concatenate([self.ancestor, kept[ANCESTOR]]),
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


def _moved(
    problem: Problem,
    some: Violating,
    rules: Sequence[Rule],
    tuning: Tuning,
    generator: np.random.Generator,
) -> tuple[Violating, BoolArray]:
    """Each after one move, and whether it has left where it was."""
    shape = shape_of(problem)
    numbers = moved(
        some.numbers,
        tuning.chosen(some.count, generator),
        shape=shape,
        scale=tuning.scale,
        spread=spreads(some.numbers, shape),
        generator=generator,
    )
    tried = Violating(numbers, simulated_beside(problem, numbers))
    accepted = _breaks(score(problem, tried.rollouts), rules) & ~lost_rows(tried.rollouts)
    accepted &= _differs(some.rollouts, tried.rollouts)
    place = np.arange(some.count) + np.where(accepted, some.count, 0)
    return Violating.concatenate([some, tried]).take(place), accepted


def _differs(one: RolloutBatch, other: RolloutBatch) -> BoolArray:
    """Whether each of N rollouts has outcomes or latents that its counterpart does not have."""
    found = (one.detected != other.detected).any(axis=1)
    if one.latents is not None and other.latents is not None:
        found |= (one.latents.start != other.latents.start).any(axis=1)
        found |= (one.latents.noise != other.latents.noise).any(axis=(1, 2))
    return found


def _breaks(scored: ScoredRollouts, rules: Sequence[Rule]) -> BoolArray:
    """Whether each of N rollouts still breaks the rule that it was drawn for."""
    verdicts = {rule: _breaking(scored, rule) for rule in set(rules)}
    return np.array([verdicts[rule][row] for row, rule in enumerate(rules)])


def _breaking(scored: ScoredRollouts, rule: Rule) -> BoolArray:
    """Which break a rule, or violate the specification."""
    return scored.broken[rule] if rule else scored.violated
