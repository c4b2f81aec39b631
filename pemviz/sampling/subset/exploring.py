"""Violations that a few short runs of chains find, for methods that are to know of all their kinds.

None of the runs has to be precise; they are independent of each other, and each searches all of the
model's probability. The run that finds their levels is one of those that search.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.sampling.particles.runs import common_ancestry
from pemviz.sampling.problem import Problem, score
from pemviz.sampling.subset.moves import RandomNumbers, Tuning
from pemviz.sampling.subset.rejuvenation import violating
from pemviz.sampling.subset.run import SubsetSimulation, finding, simulated_beside
from pemviz.types import ScoredRollouts

RUNS = 2
"""Of chains, beside the one that finds their levels."""
APART = 2
"""One in so many of the violations is kept: neighbours in a chain are nearly the same."""
SEVERAL = 2.0
"""Ancestors of what the runs found, as many independent ones would tell as much."""
SPAWN_KEY = 2**32 - 3
"""Of the child of a repetition's seed that chains are sampled by."""
KEPT, TUNING = "explored.", "explored.moves."
FIGURES = "log_weight", "log_probability", "simulated", "independent"


@dataclass(frozen=True)
class Explored:
    """What the runs found.

    Attributes:
        scored: E violations; ``None``: there are none.
        log_weight: Of each, by what its run found in all, ``[E]`` [nats].
        log_probability: What each run found, ``[R]`` [nats]; -inf: nothing violated. All but the
            first, which found the levels, are without bias.
        simulated: Rollouts that it took.
        independent: As how large a share of the violations so many independent ones would tell as
            much: those of one ancestor are much alike.
        numbers: Of which the violations come; ``None`` where there are none.
        tuning: Which moves brought most at the last level; ``None`` where there is none.
    """

    scored: ScoredRollouts | None = None
    log_weight: FloatArray = field(default_factory=lambda: np.empty(0))
    log_probability: FloatArray = field(default_factory=lambda: np.empty(0))
    simulated: int = 0
    independent: float = 1.0
    numbers: RandomNumbers | None = None
    tuning: Tuning | None = None

    @property
    def is_poor(self) -> bool:
        """Whether all of the runs found what descends from one rollout, or nothing."""
        ancestors = self.independent * self.log_weight.size
        return self.log_probability.size > 0 and ancestors < SEVERAL

    @property
    def kept(self) -> dict[str, AnyArray]:
        """What a run that goes on takes up, by name."""
        own = {f"{KEPT}{name}": np.asarray(getattr(self, name)) for name in FIGURES}
        if self.numbers is not None:
            own |= self.numbers.kept(KEPT)
        return own if self.tuning is None else own | self.tuning.kept(TUNING)

    @staticmethod
    def of_kept(problem: Problem, kept: Mapping[str, AnyArray]) -> "Explored | None":
        """What was kept, its violations simulated again; ``None`` if nothing was.

        Raises:
            SimulationError: As :func:`explore`.
        """
        if not all(f"{KEPT}{name}" in kept for name in FIGURES):
            return None
        log_weight, log_probability, simulated, independent = (
            kept[f"{KEPT}{name}"] for name in FIGURES
        )
        scored = numbers = None
        if log_weight.size:
            numbers = RandomNumbers.of_kept(kept, KEPT)
            scored = score(problem, simulated_beside(problem, numbers))
        found = Explored(
            scored, log_weight, log_probability, int(simulated), float(independent), numbers
        )
        known = any(name.startswith(TUNING) for name in kept)
        return replace(found, tuning=Tuning.of_kept(kept, TUNING)) if known else found


def explore(
    problem: Problem, *, rollouts: int, seed: int, repetition: int, most: float = math.inf
) -> Explored:
    """Runs with ``rollouts`` a level.

    If ``most`` rollouts are not enough for all, the one that finds levels is cut off, and nothing
    is found.

    Raises:
        SimulationError: Something raises, is no finite number, or a batch takes too long.
    """
    seeds = np.random.SeedSequence(seed, spawn_key=(repetition, SPAWN_KEY)).spawn(RUNS + 1)
    first, *others = (np.random.default_rng(one) for one in seeds)
    each = most / (1 + RUNS)
    if each < rollouts:
        return Explored()
    found = finding(problem, count=rollouts, generator=first, most=each)
    between = SubsetSimulation(found.levels)
    left = most - found.simulated
    if found.last is None or left < RUNS * between.most_rollouts(rollouts):
        return Explored(simulated=found.simulated)
    runs = between.carry_out_beside(problem, count=rollouts, generators=others)
    ends = [(run.scored, run.log_probability, run.common_ancestry) for run in runs]
    scored = score(problem, found.last.rollouts)
    ancestry = common_ancestry(found.last.ancestor[scored.violated])
    ends = [(scored, found.log_probability, ancestry), *ends]
    parts, log_weight, families = list[ScoredRollouts](), [np.empty(0)], 0.0
    for scored, log_probability, ancestry in ends:
        few = np.flatnonzero(scored.violated)[::APART]
        if few.size:
            parts.append(scored.take(few))
            log_weight.append(np.full(few.size, log_probability - math.log(few.size)))
            families += 1.0 / ancestry
    explored = Explored(
        log_weight=np.concatenate(log_weight),
        log_probability=np.array([log_probability for _, log_probability, _ in ends]),
        simulated=found.simulated + sum(run.simulated for run in runs),
        tuning=found.levels[-1].tuning if found.levels else None,
    )
    if not parts:
        return explored
    scored = ScoredRollouts.concatenate(parts)
    return replace(
        explored,
        scored=scored,
        independent=min(families / explored.log_weight.size, 1.0),
        numbers=violating(problem, scored.rollouts, first).numbers,
    )
