"""The proposal that conditions on violation: each outcome weighted by what follows from it.

What follows is looked up in tables of logits over cells of the state space, by hashed cell numbers.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.proposals.defensive import defended
from pemviz.types import StateBatch

# cells are shifted by a fraction that no lattice shares, so that states do not lie on edges
SHIFT = 0.381966011250105
MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
BLOCK = 8192


@dataclass(frozen=True)
class CellTable:
    """Logits by cell.

    Attributes:
        keys: Sorted hashes of the cells, ``[n]``.
        logit: Logit of 'detected' in each, ``[n]``.
    """

    keys: IntArray
    logit: FloatArray

    def find(self, keys: IntArray) -> tuple[FloatArray, BoolArray]:
        """Logits for hashes ``[m]`` and whether the table has them; 0 where it does not."""
        if self.keys.size == 0:
            return np.zeros(keys.size), np.zeros(keys.size, dtype=np.bool_)
        place = np.minimum(np.searchsorted(self.keys, keys), self.keys.size - 1)
        is_cell = self.keys[place] == keys
        return np.where(is_cell, self.logit[place], 0.0), is_cell


def cell_keys(columns: Sequence[FloatArray], cells: Sequence[float]) -> IntArray:
    """Hash ``[n]`` of the cell numbers of points given by columns ``[n]`` and cell sizes.

    Sixty-four bits: two of a million cells collide with probability 3e-8.
    """
    keys = np.empty(columns[0].size, dtype=np.uint64)
    for start in range(0, keys.size, BLOCK):  # in place, in what the processor's cache holds
        key = keys[start : start + BLOCK]
        key[:] = 0
        scratch = np.empty_like(key)
        for column, cell in zip(columns, cells, strict=True):
            number = column[start : start + BLOCK] / cell
            number += SHIFT
            key *= MULTIPLIER
            key += np.floor(number, out=number).astype(np.int64).view(np.uint64)
            _mix(key, scratch)
    return keys.view(np.int64)


def _mix(key: AnyArray, scratch: AnyArray) -> None:
    """The finaliser of splitmix64 (Steele, Lea, Flood 2014), in place."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        np.right_shift(key, np.uint64(shift), out=scratch)
        np.bitwise_xor(key, scratch, out=key)
        key *= np.uint64(factor)


@dataclass(frozen=True, kw_only=True)
class ZeroVarianceTables:
    """What is known about one step, from the finest table to the coarsest.

    Attributes:
        states: Logits of single states; keys of all ``names``, cells ``distance`` wide.
        coarse: Averages over ever larger cells of the signals alone, by their number.
    """

    states: CellTable
    coarse: Mapping[int, CellTable]


@dataclass(frozen=True, kw_only=True, eq=False)
class ZeroVarianceProposal:
    """q(o | s) = p(o | s) V(s after o) / V(s), with V the probability of violation.

    With the true V every violating rollout has the same weight, the failure probability
    itself (the zero-variance change of measure). States that the tables do not hold, as when
    a simulator differs from the twin that V was computed on, take the average of the states
    around them; states far from all of them take the error model's own probabilities.

    Attributes:
        tables: By step.
        names: Signals and memory that identify a state, in the order of keys.
        signal_names: The signals among them, as the coarse tables use them.
        distance: Cell size of the finest tables.
        coarse_cells: For each coarse table, its cell sizes by signal.
        violated: Name of the memory that says whether the rollout has violated already: from
            then on the error model is sampled from.
        defensive: No outcome is sampled with less than this share of its probability under
            the error model.
        log_probability: Log of the failure probability that V gives at the start.
        exact: Whether V is that of the twin up to rounding.
        left_out: Share of the failure probability that leads by way of states whose V is 0 all
            the same; 0 where V is exact.
    """

    tables: tuple[ZeroVarianceTables, ...]
    names: tuple[str, ...]
    signal_names: tuple[str, ...]
    distance: float
    coarse_cells: tuple[tuple[float, ...], ...]
    violated: str
    defensive: float
    log_probability: float
    exact: bool
    left_out: float
    certain: Callable[[StateBatch], BoolArray] | None = None

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]``; the step may differ along the last axis."""
        shape = pem_logit.shape
        step = np.broadcast_to(states.step, shape).ravel()
        under_pem = pem_logit.ravel()
        violated = np.asarray(states.memory.get(self.violated, False), dtype=np.bool_)
        open_ = ~np.broadcast_to(violated, shape).ravel()
        result = under_pem.copy()
        for value in np.unique(step):
            if value < len(self.tables):
                chosen = np.flatnonzero((step == value) & open_)
                here = _at_step(int(value), states, shape=shape, rows=chosen)
                if self.certain is not None and all(name in _columns(here) for name in self.names):
                    left = np.flatnonzero(~self.certain(here))
                    chosen, here = chosen[left], here.take(left)
                result[chosen] = self._logit_at(int(value), _columns(here), under_pem[chosen])
        return result.reshape(shape)

    def arrays(self) -> Mapping[str, AnyArray]:
        """Scalars only: the tables follow from the configuration and may be very large."""
        return {
            "defensive": np.array(self.defensive),
            "log_probability": np.array(self.log_probability),
        }

    def _logit_at(
        self, step: int, columns: Mapping[str, FloatArray], pem_logit: FloatArray
    ) -> FloatArray:
        optimal, found = self._find(self.tables[step], columns, pem_logit.size)
        return np.where(found, defended(optimal, pem_logit, share=self.defensive), pem_logit)

    def _find(
        self, tables: ZeroVarianceTables, columns: Mapping[str, FloatArray], count: int
    ) -> tuple[FloatArray, BoolArray]:
        logit, found = np.zeros(count), np.zeros(count, dtype=np.bool_)
        if all(name in columns for name in self.names):
            cells = [self.distance] * len(self.names)
            logit, found = tables.states.find(cell_keys([columns[n] for n in self.names], cells))
        for table, cells in enumerate(self.coarse_cells):
            left = np.flatnonzero(~found)
            if left.size == 0:
                break
            keys = cell_keys([columns[name][left] for name in self.signal_names], cells)
            logit[left], found[left] = tables.coarse[table].find(keys)
        return logit, found


def _at_step(
    step: int, states: StateBatch, *, shape: tuple[int, ...], rows: IntArray
) -> StateBatch:
    """States ``[M]`` of one step, which ``rows [M]`` of all ``[...]`` are."""

    def chosen(values: Mapping[str, AnyArray]) -> Mapping[str, AnyArray]:
        return {name: np.broadcast_to(v, shape).ravel()[rows] for name, v in values.items()}

    return StateBatch(np.array(step), chosen(states.signals), chosen(states.memory))


def _columns(states: StateBatch) -> Mapping[str, AnyArray]:
    return {**states.signals, **states.memory}
