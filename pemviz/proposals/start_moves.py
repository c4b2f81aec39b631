"""How a proposal moves the latents at the start: means, and spreads for half of its rollouts.

A violation may need a start that is rare by itself, and the starts that it needs lie closer to each
other than those of the model do. With z, m and s vectors,

    q(z) = (N(z; m, 1) + N(z; m, s^2)) / 2

so that half keeps the model's own spread, and no weight grows without bound where s is too small.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.latents import log_moved

LEAST_SPREAD = 0.2
SPREAD_RIDGE = 5.0
"""So many starts of spread 1 count beside those that a spread is fitted to."""


@dataclass(frozen=True, eq=False)
class StartMoves:
    """Means and spreads.

    Attributes:
        mean: ``[S]``; of N rollouts each its own, ``[N, S]``.
        sd: Spreads of half of the rollouts, likewise; 1 is that of the model.
    """

    mean: FloatArray
    sd: FloatArray

    @staticmethod
    def none(starts: int) -> "StartMoves":
        """Those of the model."""
        return StartMoves(np.zeros(starts), np.ones(starts))

    @staticmethod
    def of_each(rollouts: Sequence["StartMoves"]) -> "StartMoves":
        """Of N rollouts, each its own."""
        return StartMoves(
            np.stack([one.mean for one in rollouts]), np.stack([one.sd for one in rollouts])
        )

    def rows(self, rows: slice) -> "StartMoves":
        """Of some of the rollouts."""
        return StartMoves(self.mean[rows], self.sd[rows])

    def log_ratio(self, start: FloatArray) -> FloatArray:
        """Log q / p of starts ``[N, S]``, ``[N]`` [nats]."""
        return log_moved(start, self.mean, self.sd)


def fit_start(start: FloatArray, weight: FloatArray, *, ridge: float) -> StartMoves:
    """The moves nearest to weighted starts.

    Args:
        start: ``[N, S]``.
        weight: ``[N]``, not negative.
        ridge: So many starts at 0 count beside those that means are fitted to, above 0.
    """
    total = float(weight.sum())
    mean = weight @ start / (total + ridge)
    return StartMoves(mean, _spread(weight @ (start - mean) ** 2, total))


def start_optimism(
    moves: StartMoves, start: FloatArray, weight: FloatArray, *, ridge: float
) -> FloatArray:
    """By how much each start is likelier than if the fit had been made without it, ``[N]`` [nats].

    Args:
        moves: Fitted by :func:`fit_start` with the other arguments.
        start: ``[N, S]``.
        weight: ``[N]``.
        ridge: Of the means.
    """
    own = weight[:, None]
    total = (float(weight.sum()) - own).clip(0.0)
    sums, squares = weight @ start - own * start, weight @ start**2 - own * start**2
    mean = sums / (total + ridge)
    around_mean = (squares - 2.0 * mean * sums + total * mean**2).clip(0.0)
    without = StartMoves(mean, _spread(around_mean, total))
    return (moves.log_ratio(start) - without.log_ratio(start)).clip(0.0)


def _spread(squares: FloatArray, total: FloatArray | float) -> FloatArray:
    """Spreads from sums of weighted squares and of the weights."""
    variance = (squares + SPREAD_RIDGE) / (total + SPREAD_RIDGE)
    return np.sqrt(variance).clip(LEAST_SPREAD, 1.0)
