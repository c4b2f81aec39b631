"""Starts that are chosen by their values: the prologue of a zero-variance proposal.

With the starts k of a quantised twin, their probabilities p_k, their values V_k and a defensive
share d, one is chosen with q_k; within its cell the start has its distribution under the model::

    q_k = (1 - d) p_k V_k / sum_j p_j V_j + d p_k
"""

from dataclasses import dataclass, fields

import numpy as np
from scipy.special import ndtr

from pemviz.arrays import FloatArray
from pemviz.proposals.zero_variance import ZeroVarianceProposal
from pemviz.sampling.zero_variance.values import Values
from pemviz.simulators.quantised import StartCells


@dataclass(frozen=True, kw_only=True, eq=False)
class StartZeroVarianceProposal(ZeroVarianceProposal):
    """A zero-variance proposal that chooses where rollouts start, too.

    Attributes:
        cells: The twin's.
        log_start_value: Log of the failure probability from each of its starts, ``[K]``.
    """

    cells: StartCells
    log_start_value: FloatArray

    def chosen_start(self, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latents ``[N, S]`` made of standard normals ``[N, S]``, and log p - log q, ``[N]``."""
        share = self._shares()
        bounds = np.cumsum(share)
        uniform = ndtr(normals)
        drawn = uniform[:, 0] * bounds[-1]
        cell = np.minimum(np.searchsorted(bounds, drawn, side="right"), share.size - 1)
        # what is left of the first draw within its cell is uniform again
        place = uniform.copy()
        place[:, 0] = np.clip((drawn - bounds[cell]) / share[cell] + 1.0, 0.0, 1.0)
        log_q = np.log(share[cell]) - np.log(bounds[-1])
        return self.cells.within(cell, place), self.cells.log_p[cell] - log_q

    def _shares(self) -> FloatArray:
        """q_k, ``[K]``."""
        under_model = np.exp(self.cells.log_p)
        if not np.isfinite(self.log_probability):
            return under_model
        given = np.exp(self.cells.log_p + self.log_start_value - self.log_probability)
        return (1.0 - self.defensive) * given + self.defensive * under_model


def with_starts(
    proposal: ZeroVarianceProposal, *, cells: StartCells, values: Values
) -> StartZeroVarianceProposal:
    """A proposal for the states of a twin with a quantised start, and for its starts."""
    plain = {part.name: getattr(proposal, part.name) for part in fields(ZeroVarianceProposal)}
    return StartZeroVarianceProposal(**plain, cells=cells, log_start_value=values.log_start_value)
