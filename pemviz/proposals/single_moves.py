"""One step of a rollout whose noise is moved, at most: which one, nobody knows.

Where a single error far out decides, the rollouts to draw have that error at one step and nothing
else moved. Were each step moved by itself with a share c, their number would vary as a binomial
does, and of the rollouts only those with one would count. With h_t the probability that step t is
moved given none before it, l_t the log density of moved over unmoved noise there:

    log q / p = log( sum_t h_t exp(l_t) prod_{s<t} (1 - h_s)  +  prod_t (1 - h_t) )

Drawn step by step without knowing the sum: with a the probability, given the noise so far, that
none was moved, step t is moved with the share a h_t, and then

    a <- a (1 - h_t) / (1 - a h_t + a h_t exp(l_t))

h may depend on the state; it has the logit 0 for all states alike where, of the steps left, each is
as likely as the other (:func:`even_logit`).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import FloatArray, IntArray, log_sum_exp
from pemviz.latents import log_share_moved

NEVER = 0.03
"""Of rollouts, with no step moved where all steps are as likely."""


def even_logit(step: IntArray, *, steps: int) -> FloatArray:
    """Logit of moving a step, given none before, by which all ``steps`` are as likely.

    Args:
        step: Zero-based, any shape.
        steps: Of a rollout.
    """
    return -np.log(steps - 1.0 - step + steps * NEVER / (1.0 - NEVER))


@dataclass(frozen=True)
class StepsOfRollouts:
    """Where L steps of N rollouts lie in a table, a rollout's steps beside each other.

    Attributes:
        rollout: Of each step, ascending, ``[L]``.
        count: N.
    """

    rollout: IntArray
    count: int

    @cached_property
    def place(self) -> IntArray:
        """Of each step in its rollout, ``[L]``."""
        number = np.bincount(self.rollout, minlength=self.count)
        first = np.cumsum(number) - number
        return np.arange(self.rollout.size) - first[self.rollout]

    def table(self, values: FloatArray, *, empty: float) -> FloatArray:
        """Values ``[L]`` as ``[N, largest number of steps]``."""
        widest = int(self.place.max()) + 1 if self.place.size else 0
        found = np.full((self.count, widest), empty)
        found[self.rollout, self.place] = values
        return found

    def before(self, values: FloatArray) -> FloatArray:
        """Sums over a rollout's earlier steps, ``[L]`` of ``[L]``."""
        table = self.table(values, empty=0.0)
        return (np.cumsum(table, axis=1) - table)[self.rollout, self.place]

    def up_to(self, chosen: FloatArray) -> FloatArray:
        """1 at the first step of each rollout that is ``chosen`` and at all before, else 0."""
        return (self.before(chosen) == 0.0).astype(np.float64)


def log_ratio_of_one(moved: FloatArray, logit: FloatArray, steps: StepsOfRollouts) -> FloatArray:
    """Log q / p of the noise of N rollouts, ``[N]``.

    Args:
        moved: Log density of moved over unmoved noise, ``[L]``.
        logit: Of moving a step, given none before, ``[L]``.
        steps: Of which rollouts they are.
    """
    each, never = _log_joint(moved, logit, steps)
    largest = steps.table(each, empty=-np.inf)
    return np.asarray(log_sum_exp(np.hstack([largest, never[:, None]]), axis=1))


def posterior_of_one(
    moved: FloatArray, logit: FloatArray, steps: StepsOfRollouts
) -> tuple[FloatArray, FloatArray]:
    """How likely each step is to be the moved one, and that none before it is, ``[L]`` each."""
    each, _ = _log_joint(moved, logit, steps)
    part = np.exp(each - log_ratio_of_one(moved, logit, steps)[steps.rollout])
    return part, np.maximum(1.0 - steps.before(part), part)


def share_of_one(share: FloatArray, steps: StepsOfRollouts) -> FloatArray:
    """Of draws, with each step moved, for shares ``[L]`` given none before."""
    return share * np.exp(steps.before(np.log1p(-share)))


def log_waiting(log_waits: FloatArray, share: FloatArray, moved: FloatArray) -> FloatArray:
    """Log of the probability that no step was moved yet, after one more, ``[n]``.

    Args:
        log_waits: The same before it, ``[n]``.
        share: Of moving it, given none before (h), ``[n]``.
        moved: Log density of moved over unmoved noise, ``[n]``.
    """
    stays = log_waits + np.log1p(-share)
    return stays - log_share_moved(moved, np.exp(log_waits) * share)


def _log_joint(
    moved: FloatArray, logit: FloatArray, steps: StepsOfRollouts
) -> tuple[FloatArray, FloatArray]:
    """Logs of the sum's terms: of each step ``[L]``, and of no step ``[N]``."""
    stays = -np.logaddexp(0.0, logit)
    each = steps.before(stays) + stays + logit + moved
    never = np.bincount(steps.rollout, weights=stays, minlength=steps.count)
    return each, never.astype(np.float64)
