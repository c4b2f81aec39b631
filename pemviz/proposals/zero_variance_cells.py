"""Tables of logits over cells of the state space, looked up by hashed cell numbers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray

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
