"""The proposal that conditions on violation, where obstacles differ.

With the values of :mod:`pemviz.sampling.zero_variance.frail`, and s' the state after an outcome::

    q(o | s, history) = P(o | s, history) V(s', history and o) / V(s, history)

Values are kept for fewer nodes than the posterior has; between them their logarithm, which is
smooth in u, is interpolated by a cubic spline. What that costs is variance, not truth.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_expit

from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.pem.models.frailty import VisibilityNodes, log_sums
from pemviz.proposals.offset_logistic import defended
from pemviz.proposals.zero_variance import ZeroVarianceProposal, cell_keys
from pemviz.sampling.state.visibility import NEXT
from pemviz.sampling.zero_variance.reachable_states import UNSAFE_NODE
from pemviz.types import StateBatch

LOWEST, HIGHEST = -2.5, 8.5
"""Of the nodes that values are kept for; beyond, their logarithm goes on as a straight line."""
WIDEST, MOST = 1.0, 32
"""Largest distance of these nodes, and how many there are at most."""


@dataclass(frozen=True, eq=False)
class KnownValues:
    """What is known of one step's states, in the order of their keys.

    Attributes:
        keys: Sorted hashes of the states, ``[n]``.
        after_miss: Index ``[n]`` in the next step's, or SAFE_NODE or UNSAFE_NODE.
        after_hit: The same after a detection.
        log_value: Log V(s | u_k) at the nodes that values are kept for, ``[n, K]``.
    """

    keys: IntArray
    after_miss: IntArray
    after_hit: IntArray
    log_value: AnyArray


@dataclass(frozen=True, kw_only=True, eq=False)
class FrailZeroVarianceProposal(ZeroVarianceProposal):
    """Where it does not know a state's values, or outcomes so far, it is what it is derived from.

    Attributes:
        known: By step.
        between: From values at the nodes kept to those at the posterior's nodes, ``[K, J]``.
    """

    known: tuple[KnownValues, ...]
    between: FloatArray

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]``."""
        result = super().logit(states, pem_logit)
        if NEXT not in states.memory or int(states.step) >= len(self.known):
            return result
        step = int(states.step)
        columns = {**states.signals, **states.memory}
        keys = cell_keys([columns[name] for name in self.names], [self.distance] * len(self.names))
        known = self.known[step]
        place = np.searchsorted(known.keys, keys)
        place[place == known.keys.size] = 0
        found = known.keys[place] == keys
        found &= ~np.asarray(columns.get(self.violated, False), dtype=np.bool_)
        rows = np.flatnonzero(found)
        under_pem = pem_logit[rows]
        after = states.memory[NEXT][rows]
        miss = self._log_value(step + 1, known.after_miss[place[rows]], after["missed"])
        hit = self._log_value(step + 1, known.after_hit[place[rows]], after["detected"])
        possible = np.isfinite(miss) | np.isfinite(hit)
        with np.errstate(invalid="ignore"):  # neither outcome leads to a violation
            optimal = hit + log_expit(under_pem) - miss - log_expit(-under_pem)
        optimal = np.where(possible, optimal, 0.0)
        result[rows] = np.where(
            possible, defended(optimal, under_pem, share=self.defensive), under_pem
        )
        return result

    def _log_value(self, step: int, node: IntArray, log_posterior: FloatArray) -> FloatArray:
        """Log V ``[m]`` of states of a step with posteriors ``[m, J]``."""
        result = np.where(node == UNSAFE_NODE, 0.0, -np.inf)
        live = np.flatnonzero(node >= 0)
        if live.size:
            kept = self.known[step].log_value[node[live]].astype(np.float64)
            # einsum, unlike a library's matrix product, gives a row the same in any batch
            log_value = np.minimum(np.einsum("nk,kj->nj", kept, self.between), 0.0)
            result[live] = log_sums(log_posterior[live] + log_value)
        return result


def value_nodes(frailty: float) -> FloatArray:
    """The u_k ``[K]`` that values are kept for: their logarithm changes within 1 / frailty."""
    distance = min(WIDEST, 1.0 / frailty)
    count = min(1 + round((HIGHEST - LOWEST) / distance), MOST)
    return np.linspace(LOWEST, HIGHEST, count)


def between_nodes(kept: FloatArray, nodes: VisibilityNodes) -> FloatArray:
    """Weights ``[K, J]`` that interpolate values at ``kept [K]`` to ``nodes``; linear beyond."""
    from scipy.interpolate import make_interp_spline  # noqa: PLC0415  slow to import

    spline = make_interp_spline(kept, np.eye(kept.size), k=3)
    u, slope = np.clip(nodes.u, kept[0], kept[-1]), spline.derivative()
    return np.asarray(spline(u) + slope(u) * (nodes.u - u)[:, None], dtype=np.float64).T
