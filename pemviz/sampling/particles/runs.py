"""What one of several independent runs of particles found, and what is kept of it.

Methods that cut and replace particles level by level, ``splitting`` and ``subset``, give these.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.faults import SimulationError
from pemviz.sampling.rollouts.large_stages import log_p_of
from pemviz.types import ScoredRollouts


@dataclass(frozen=True)
class RunFigures:
    """What an estimate needs of an independent run of ``count`` particles, F of which violate.

    Attributes:
        log_probability: Its estimate; -inf if the particles died out.
        least_variance: Variance of ``log_probability`` if the importance function were the
            probability of a violation itself: no other has a smaller one.
        common_ancestry: Of two violating particles, how often both descend from one particle
            at the start.
        simulated: Rollouts begun or continued.
        levels: How often particles were cut.
        count: How many particles.
        log_p: Log likelihood of those that violate under the error model, ``[F]`` [nats].
    """

    log_probability: float
    least_variance: float
    common_ancestry: float
    simulated: int
    levels: int
    count: int
    log_p: FloatArray

    def of_share(self, share: float, *, before: float) -> Self:
        """The same where a share of the particles counts as violating, which was ``before``."""
        if self.log_probability == -math.inf or share == 0.0:
            return replace(self, log_probability=-math.inf)
        return replace(
            self,
            log_probability=self.log_probability + math.log(share / before),
            least_variance=self.least_variance + (1.0 / share - 1.0 / before) / self.count,
        )


@dataclass(frozen=True)
class ParticleRun(RunFigures):
    """A run with its particles at the end, and ``common_ancestry`` of those that break a rule."""

    scored: ScoredRollouts
    rule_ancestry: Mapping[str, float] = field(default_factory=dict[str, float])

    def under_rule(self, rule: str) -> "ParticleRun":
        """The same particles, of which those that break one rule violate."""
        broken = self.scored.broken[rule]
        before = float(self.scored.violated.mean())
        return replace(
            self.of_share(float(broken.mean()), before=before),
            common_ancestry=self.rule_ancestry[rule],
            log_p=log_p_of(self.scored.rollouts, broken),
            scored=replace(self.scored, violated=broken),
        )


def copies(of: int, count: int, generator: np.random.Generator) -> IntArray:
    """Which of so many each of ``count`` is a copy of: all as often as any other but for one."""
    whole, rest = divmod(count, of)
    some = generator.permutation(of)[:rest]
    return np.concatenate([np.tile(np.arange(of), whole), some]).astype(np.int64)


def tell_run(error: SimulationError, places: Mapping[int, tuple[int, int]]) -> None:
    """Let a fault name a run's rollout, of all that were simulated, one run after the other.

    Args:
        error: What names one of all, or all.
        places: By run: how many of its rollouts come before those, and how many those are.
    """
    rows = error.rollouts
    if rows is None:
        return
    alone = len(places) == 1 and all(before == 0 for before, _ in places.values())
    if len(rows) > 1 and not alone:
        error.among, error.rollouts = len(rows), None
        return
    row = rows[0]
    for run, (before, size) in places.items():
        if row < size:
            first = before + row
            error.ahead, error.rollouts = run, range(first, first + len(rows))
            return
        row -= size


def log_product(shares: Sequence[float]) -> float:
    """Log of a product of shares [nats]; -inf if one is 0."""
    return sum(math.log(share) if share > 0.0 else -math.inf for share in shares)


def common_ancestry(ancestor: IntArray) -> float:
    """Of two of the particles ``[M]``, with replacement, how often both have one ancestor.

    What Lee and Whiteley 2018 (section 2.3) estimate a particle approximation's relative variance
    from: near it where few pairs do, and at most 1 however large the variance is.
    """
    if not ancestor.size:
        return 1.0
    return float(np.sum((np.bincount(ancestor) / ancestor.size) ** 2))
