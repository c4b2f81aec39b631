"""From the reachable states' values to the proposal: tables of outcomes, and starts to begin from.

With the starts k of a quantised twin, their probabilities p_k, their values V_k and a defensive
share d, one is chosen with q_k; within its cell the start has its distribution under the model::

    q_k = (1 - d) p_k V_k / sum_j p_j V_j + d p_k
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import ndtr

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.chunks import distinct
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.defensive import share_for
from pemviz.proposals.zero_variance import (
    CellTable,
    ZeroVarianceProposal,
    ZeroVarianceTables,
    cell_keys,
)
from pemviz.sampling.zero_variance.left_out import left_out_share
from pemviz.sampling.zero_variance.reachable_states import (
    LARGEST_LAYER,
    MERGE_DISTANCE,
    Layer,
    Pause,
    StateGraph,
    Unsafe,
    explore,
    no_pause,
    state_columns,
    state_names,
)
from pemviz.sampling.zero_variance.values import (
    Values,
    both_log_likelihoods,
    log_sum_by,
    solve,
)
from pemviz.simulators.latents import begun
from pemviz.simulators.quantised import StartCells, start_cells
from pemviz.types import VIOLATED, Simulator

COARSE_SHARES = (1e-3, 4e-3, 1.6e-2, 6.4e-2)
NEGLIGIBLE_SHARE = 1e-12
DEFENSIVE_STEPS = 2.0
APPROXIMATE_DEFENCE = 2.5


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
        share = np.exp(self.cells.log_p)
        if np.isfinite(self.log_probability):
            given = np.exp(self.cells.log_p + self.log_start_value - self.log_probability)
            share = (1.0 - self.defensive) * given + self.defensive * share
        bounds = np.cumsum(share)
        uniform = ndtr(normals)
        place_in_all = uniform[:, 0] * bounds[-1]
        cell = np.minimum(np.searchsorted(bounds, place_in_all, side="right"), share.size - 1)
        # what is left of the first number within its cell is uniform again
        place = uniform.copy()
        place[:, 0] = np.clip((place_in_all - bounds[cell]) / share[cell] + 1.0, 0.0, 1.0)
        log_q = np.log(share[cell]) - np.log(bounds[-1])
        return self.cells.within(cell, place), self.cells.log_p[cell] - log_q


def build_zero_variance_proposal(
    *,
    twin: Simulator,
    pem: Pem,
    unsafe: Unsafe,
    largest_layer: int = LARGEST_LAYER,
    pause: Pause = no_pause,
) -> ZeroVarianceProposal:
    """Explore the twin, solve for the probability of violation, tabulate the proposal.

    Args:
        twin: A scenario whose ``step`` is cheap for many states.
        pem: The error model.
        unsafe: What violates the specification.
        largest_layer: Above so many states a step, neighbours are taken for one.
        pause: Called every few tenths of a second; may raise to stop.
    """
    graph = explore(twin=twin, pem=pem, unsafe=unsafe, largest_layer=largest_layer, pause=pause)
    values = solve(graph, pause=pause)
    left_out = 0.0
    if not graph.exact:
        left_out = left_out_share(graph, values, twin=twin, pem=pem, unsafe=unsafe, pause=pause)
    proposal = tabulated(graph, values, twin=twin, left_out=left_out, pause=pause)
    cells = start_cells(twin)
    if cells is None:
        return proposal
    plain = {part.name: getattr(proposal, part.name) for part in fields(proposal)}
    return StartZeroVarianceProposal(**plain, cells=cells, log_start_value=values.log_start_value)


def tabulated(
    graph: StateGraph, values: Values, *, twin: Simulator, left_out: float, pause: Pause = no_pause
) -> ZeroVarianceProposal:
    """The proposal that follows from the values of the states of a graph, explored on the twin.

    ``left_out`` is the share of the failure probability that leads by way of states called safe;
    ``pause`` is called every few tenths of a second.
    """
    signals = sorted(twin.signals, key=lambda signal: signal.name)
    cells = tuple(
        tuple(share * (signal.high - signal.low) for signal in signals) for share in COARSE_SHARES
    )
    return ZeroVarianceProposal(
        tables=tuple(
            _tables(layer, values, index, cells=cells, pause=pause)
            for index, layer in enumerate(graph.layers)
        ),
        names=state_names(begun(twin, count=1)),
        signal_names=tuple(signal.name for signal in signals),
        distance=MERGE_DISTANCE,
        coarse_cells=cells,
        violated=VIOLATED,
        defensive=share_for(drawn_steps=DEFENSIVE_STEPS, steps=twin.states - 1),
        log_probability=values.log_probability,
        exact=graph.exact,
        left_out=left_out,
        certain=graph.certain,
    )


def with_defence(
    proposal: ZeroVarianceProposal, *, defensive_steps: float, steps: int
) -> ZeroVarianceProposal:
    """The proposal with so many of a rollout's ``steps`` sampled from the error model, on average.

    That is the price of bounded weights where the twin is wrong; it is raised where states
    had to be merged.
    """
    from_model = defensive_steps * (1.0 if proposal.exact else APPROXIMATE_DEFENCE)
    return replace(proposal, defensive=share_for(drawn_steps=from_model, steps=steps))


def counting(values: Values, index: int) -> BoolArray:
    """Which states ``[n]`` of a layer more than a negligible share of the probability leads by."""
    return _log_share(values, index) > np.log(NEGLIGIBLE_SHARE)


def _log_share(values: Values, index: int) -> FloatArray:
    return values.log_value[index] + values.log_reached[index] - values.log_probability


def _tables(
    layer: Layer,
    values: Values,
    index: int,
    *,
    cells: tuple[tuple[float, ...], ...],
    pause: Pause,
) -> ZeroVarianceTables:
    counts = counting(values, index)
    logit, log_share = values.proposal_logit[index][counts], _log_share(values, index)[counts]
    columns = [column[counts] for column in state_columns(layer.states)]
    keys = cell_keys(columns, [MERGE_DISTANCE] * len(columns))
    order = np.argsort(keys)  # no key is there twice: states that share one were merged
    signals = columns[: len(layer.states.signals)]
    miss, hit = both_log_likelihoods(logit)
    miss += log_share
    hit += log_share
    pause()
    return ZeroVarianceTables(
        states=CellTable(keys=keys[order], logit=logit[order]),
        coarse=_CoarseTables(cells, signals, miss, hit),
    )


class _CoarseTables(dict[int, CellTable]):
    """Averages over cells of several sizes, each made when it is first looked up.

    Rollouts of a twin that is right come to single states that are known, or hardly count.
    """

    def __init__(
        self,
        cells: Sequence[Sequence[float]],
        signals: Sequence[FloatArray],
        log_miss: FloatArray,
        log_hit: FloatArray,
    ) -> None:
        super().__init__()
        self._of_states = (cells, signals, log_miss, log_hit)

    def __missing__(self, size: int) -> CellTable:
        cells, signals, log_miss, log_hit = self._of_states
        keys = cell_keys(signals, cells[size])
        self[size] = averaged(keys, log_miss=log_miss, log_hit=log_hit)
        return self[size]


def averaged(keys: IntArray, *, log_miss: FloatArray, log_hit: FloatArray) -> CellTable:
    """One logit for each distinct key: that of the mean probability, weighted by states' shares.

    The mean is the constant with the least cross-entropy from the states' own probabilities. Of
    states ``[n]``: their ``keys``, and the log of their share times their probability of either
    outcome.
    """
    first, group = distinct(keys)
    order = np.argsort(keys[first])
    hit, miss = (log_sum_by(group, parts, first.size)[order] for parts in (log_hit, log_miss))
    return CellTable(keys=keys[first][order], logit=hit - miss)
