"""Plain rollouts in the pool: what they bound, what they tell of the proposals, and how many pay.

Rollouts from the error model itself are a component as any other. With a share a of them no weight
is above 1 / a: no way of failing is sampled worse than plain counting would sample it. Those that
violate join the pool with their likelihoods, and proposals are fitted to them too; the others
count.

They are also the judges of the proposals beside them. With w the weight p / q that a rollout has as
one of the others' mixture q, and i telling that it violates, i w varies under q by mu m - mu^2 with
m = E_p[w | violates], and a plain rollout's i by mu - mu^2: m is how many times as much.
What has never been drawn does not show in weights of what has been drawn from q; in those of plain
violations it does. Rollouts are shared out by what one of them tells of the probability:

    a = m / (1 + m)

m is the mean over all plain violations, each weighed before anything is fitted to it, and over one
more whose weight is what the pool's own effective sample size claims. A run that expects a plain
violation among all its rollouts keeps a tenth of them plain at least, so that there are judges; one
that expects none has some in its first stage alone.
"""

from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size
from pemviz.sampling.mixture.balance_heuristic import PLAIN, Pool, log_shares, weights
from pemviz.types import ScoredRollouts

FIRST_SHARE = 0.05
"""Of the first stage."""
LEAST_SHARE = 0.1
"""Of the later ones where violations are frequent."""
MOST = 0.9
"""Of a stage: proposals that were poor may learn."""


@dataclass(frozen=True)
class PlainRollouts:
    """Rollouts that were sampled from the error model before a run of the method.

    Their states remember what is broken, as :func:`pemviz.sampling.mixture.stages.watching` has it.

    Attributes:
        count: How many.
        row: Which of them violate, or are lost, ascending, ``[F]``.
        chosen: These.
    """

    count: int
    row: IntArray
    chosen: ScoredRollouts


@dataclass(frozen=True)
class PlainViolations:
    """What plain rollouts tell of the other proposals.

    Attributes:
        count: How many violated.
        weight: Sum of the weights that they would have, had they come from the others.
        share: How many of the next stage's rollouts are to be plain.
    """

    count: int = 0
    weight: float = 0.0
    share: float = FIRST_SHARE

    def after(self, pool: Pool, *, first: int, planned: int) -> "PlainViolations":
        """With a stage's rollouts, those of the pool from ``first`` on, to which nothing is fitted.

        ``planned`` is how many rollouts the whole run has.
        """
        row = np.searchsorted(pool.rows, first)
        newest = np.arange(row, len(pool.log_ratio))
        plain = newest[pool.violated[newest] & (pool.component[pool.rows[newest]] == PLAIN)]
        log_weight = _by_others(pool, plain)
        judged = replace(
            self,
            count=self.count + plain.size,
            weight=self.weight + float(np.exp(log_weight).sum()),
        )
        return replace(judged, share=judged._share(pool, planned))

    def _share(self, pool: Pool, planned: int) -> float:
        log_weight = pool.log_weight[pool.violated]
        if not log_weight.size:
            return 0.0
        probability = min(float(np.exp(log_weight).sum()) / pool.sampled, 1.0)
        claimed = probability * pool.sampled / effective_sample_size(log_weight)
        relative = (self.weight + claimed) / (self.count + 1.0)
        least = LEAST_SHARE * min(1.0, planned * probability)
        return min(max(least, relative / (1.0 + relative)), MOST)


def _by_others(pool: Pool, rows: IntArray) -> FloatArray:
    """Log weights ``[n]`` of some of the pool's rollouts as samples from all but the model."""
    counts = np.bincount(pool.component, minlength=pool.log_ratio.shape[1])
    counts[PLAIN] = 0
    return weights(pool.log_ratio[rows], log_shares(counts))
