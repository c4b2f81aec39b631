"""What one of several independent runs of particles found, and what is kept of it.

Methods that cut and replace particles level by level, ``splitting`` and ``subset``, give these.
"""

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self, TypeVar

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.faults import SimulationError
from pemviz.sampling.rollouts.large_stages import log_p_of
from pemviz.types import ScoredRollouts

Wanted = TypeVar("Wanted")
Given = TypeVar("Given")
Ended = TypeVar("Ended")


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

    @staticmethod
    def ended(
        scored: ScoredRollouts, *, ancestor: IntArray, shares: Sequence[float], simulated: int
    ) -> "ParticleRun":
        """A run whose N particles are ``scored`` at the end.

        Args:
            scored: They.
            ancestor: Which of the particles at the start each descends from, ``[N]``.
            shares: Of the particles that came below each level.
            simulated: Rollouts begun or continued.
        """
        count = scored.rollouts.count
        shares = [*shares, float(scored.violated.mean())]
        return ParticleRun(
            log_probability=log_product(shares),
            least_variance=sum((1.0 - share) / share for share in shares if share > 0.0) / count,
            common_ancestry=common_ancestry(ancestor[scored.violated]),
            simulated=simulated,
            levels=len(shares) - 1,
            count=count,
            log_p=log_p_of(scored.rollouts, scored.violated),
            scored=scored,
            rule_ancestry={
                name: common_ancestry(ancestor[broken]) for name, broken in scored.broken.items()
            },
        )

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


def in_step(
    going: Sequence[Generator[Wanted, Given, Ended]],
    answer: Callable[[Mapping[int, Wanted]], Sequence[Given]],
) -> Sequence[Ended]:
    """What comes of runs that go on together, each as a generator of what it wants next.

    ``answer`` gets what those want that have not ended, by their number, and gives it in order.
    """
    wanted = {index: next(one) for index, one in enumerate(going)}
    ended: dict[int, Ended] = {}
    while wanted:
        for index, given in zip(list(wanted), answer(wanted), strict=True):
            try:
                wanted[index] = going[index].send(given)
            except StopIteration as end:
                del wanted[index]
                ended[index] = end.value
    return [ended[index] for index in range(len(going))]


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
