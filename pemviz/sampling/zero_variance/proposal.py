"""From the reachable states' values to the proposal: tables of outcomes, and starts to begin from.

With the starts k of a quantised twin, their probabilities p_k, their values V_k and a defensive
share d, one is chosen with q_k; within its cell the start has its distribution under the model::

    q_k = (1 - d) p_k V_k / sum_j p_j V_j + d p_k
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import overload

import numpy as np
from scipy.special import ndtr

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.chunks import distinct
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.offset_logistic import share_for
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
from pemviz.simulators.absorbing import VIOLATED
from pemviz.simulators.latents import begun
from pemviz.simulators.quantised import StartCells, start_cells
from pemviz.types import Signal, Simulator


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


COARSE_SHARES = (1e-3, 4e-3, 1.6e-2, 6.4e-2)
NEGLIGIBLE_SHARE = 1e-12
DEFENSIVE_STEPS = 2.0
APPROXIMATE_DEFENCE = 2.5


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
    return proposal if cells is None else with_starts(proposal, cells=cells, values=values)


def tabulated(
    graph: StateGraph, values: Values, *, twin: Simulator, left_out: float, pause: Pause = no_pause
) -> ZeroVarianceProposal:
    """The proposal that follows from the values of a graph's states.

    Args:
        graph: Explored on the twin.
        values: Of the graph.
        twin: The scenario.
        left_out: Share of the failure probability that leads by way of states called safe.
        pause: Called every few tenths of a second; may raise to stop.
    """
    cells = tuple(
        tuple(share * (signal.high - signal.low) for signal in _sorted_signals(twin))
        for share in COARSE_SHARES
    )
    return ZeroVarianceProposal(
        tables=tuple(
            _tables(layer, values, index, cells=cells, pause=pause)
            for index, layer in enumerate(graph.layers)
        ),
        names=state_names(begun(twin, count=1)),
        signal_names=tuple(signal.name for signal in _sorted_signals(twin)),
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
    """The proposal with so many of a rollout's ``steps`` drawn from the error model, on average.

    That is the price of bounded weights where the twin is wrong; it is raised where states
    had to be merged.
    """
    drawn = defensive_steps * (1.0 if proposal.exact else APPROXIMATE_DEFENCE)
    return replace(proposal, defensive=share_for(drawn_steps=drawn, steps=steps))


def counting(values: Values, index: int) -> BoolArray:
    """Which states ``[n]`` of a layer more than a negligible share of the probability leads by."""
    log_share = values.log_value[index] + values.log_reached[index] - values.log_probability
    return log_share > np.log(NEGLIGIBLE_SHARE)


def _sorted_signals(twin: Simulator) -> Sequence[Signal]:
    return sorted(twin.signals, key=lambda signal: signal.name)


def _tables(
    layer: Layer,
    values: Values,
    index: int,
    *,
    cells: tuple[tuple[float, ...], ...],
    pause: Pause,
) -> ZeroVarianceTables:
    logit = values.proposal_logit[index]
    log_share = values.log_value[index] + values.log_reached[index] - values.log_probability
    counts = counting(values, index)
    columns = [column[counts] for column in state_columns(layer.states)]
    keys = cell_keys(columns, [MERGE_DISTANCE] * len(columns))
    signals = columns[: len(layer.states.signals)]
    miss, hit = both_log_likelihoods(logit[counts])
    miss += log_share[counts]
    hit += log_share[counts]
    pause()
    return ZeroVarianceTables(
        states=_sorted(keys, logit[counts]), coarse=_WhenAsked(cells, signals, miss, hit)
    )


class _WhenAsked(Sequence[CellTable]):
    """Averages over cells of several sizes, each made when it is first asked for.

    Rollouts of a twin that is right come to single states that are known, or hardly count.
    """

    def __init__(
        self,
        cells: Sequence[Sequence[float]],
        signals: Sequence[FloatArray],
        log_miss: FloatArray,
        log_hit: FloatArray,
    ) -> None:
        self._cells = cells
        self._of_states = (signals, log_miss, log_hit)
        self._made: dict[int, CellTable] = {}

    def __len__(self) -> int:
        return len(self._cells)

    @overload
    def __getitem__(self, index: int) -> CellTable: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[CellTable]: ...
    def __getitem__(self, index: int | slice) -> CellTable | Sequence[CellTable]:
        if isinstance(index, slice):
            return [self[one] for one in range(len(self))[index]]
        one = range(len(self))[index]
        if one not in self._made:
            signals, log_miss, log_hit = self._of_states
            keys = cell_keys(signals, self._cells[one])
            self._made[one] = averaged(keys, log_miss=log_miss, log_hit=log_hit)
        return self._made[one]


def averaged(keys: IntArray, *, log_miss: FloatArray, log_hit: FloatArray) -> CellTable:
    """One logit for each distinct key: that of the mean probability, weighted by states' shares.

    The mean is the constant with the least cross-entropy from the states' own probabilities.

    Args:
        keys: Of each state ``[n]``.
        log_miss: Log of the state's share times its probability of a miss, ``[n]``.
        log_hit: The same of a hit.
    """
    first, group = distinct(keys)
    order = np.argsort(keys[first])
    hit, miss = (log_sum_by(group, parts, first.size)[order] for parts in (log_hit, log_miss))
    return CellTable(keys=keys[first][order], logit=hit - miss)


def _sorted(keys: IntArray, logit: FloatArray) -> CellTable:
    order = np.argsort(keys)  # no key is there twice: states that share one were merged
    return CellTable(keys=keys[order], logit=logit[order])
