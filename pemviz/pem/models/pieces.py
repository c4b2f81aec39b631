"""A network's answers to many rows that differ in one pose variable alone, as along a gap.

A rectified network is linear in one input between the places where one of its hidden units changes
sign. These kinks are found layer by layer; the network itself answers at them, and in between its
answers are interpolated: the same but for rounding.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import FloatArray
from pemviz.chunks import map_distinct, map_rows
from pemviz.pem.models.ensemble import EnsemblePem, mean_probability_logit
from pemviz.pem.models.network import POSE_INDEX, NetworkPem, paper_inputs
from pemviz.pem.models.protocol import DetectorModel, Pem, as_rows


@runtime_checkable
class Remembers(Protocol):
    """A model whose answer follows from that of a model of single outcomes, and what was before."""

    @property
    def pem(self) -> Pem:
        """The model of single outcomes."""
        ...

    def own_salient(self, salient: FloatArray) -> FloatArray:
        """What that sees ``[..., D]``, of salient variables ``[..., D + K]``."""
        ...

    def after(self, own: FloatArray, salient: FloatArray) -> FloatArray:
        """Logits ``[...]`` from its ``own [...]``, at salient variables ``[..., D + K]``."""
        ...


FEWEST_ROWS = 1000
"""Fewer are evaluated one by one: kinks are some sixty rows, and take time to find."""


def logit_along(pem: DetectorModel, salient: ArrayLike) -> FloatArray:
    """As ``pem.logit``, within 1e-12, and faster for many rows that differ in one pose variable.

    Any model but a network of the paper's inputs, or an ensemble of such, is evaluated as it is.

    Args:
        pem: The model.
        salient: Salient variables ``[..., 11]``, of which the logits are ``[...]``.

    Raises:
        PemError: The rows are not ones that the model was made for.
    """
    if isinstance(pem, EnsemblePem | NetworkPem) and pem.own is not None:
        return pem.logit(np.asarray(salient))
    if type(pem) is EnsemblePem:
        rows, shape = as_rows(salient)
        return map_distinct(lambda distinct: _mean_along(pem, distinct), rows).reshape(shape)
    if type(pem) is not NetworkPem:
        return pem.logit(np.asarray(salient))
    rows, shape = as_rows(salient)
    return _along(pem, rows, _varying_pose(rows)).reshape(shape)


def chain_logit_along(pem: DetectorModel, salient: FloatArray) -> FloatArray:
    """The same for a model that sees what came before too, as further salient variables."""
    if not isinstance(pem, Remembers):
        return logit_along(pem, salient)
    return pem.after(logit_along(pem.pem, pem.own_salient(salient)), salient)


def _varying_pose(rows: FloatArray) -> int | None:
    """The one column in which rows ``[n, 11]`` differ; ``None`` where interpolating won't do."""
    if len(rows) < FEWEST_ROWS:
        return None
    varying = [column for column, values in enumerate(rows.T) if (values != values[:1]).any()]
    # a model itself says which row is not finite
    known = len(varying) == 1 and bool(np.isfinite(rows).all())
    return varying[0] if known and varying[0] in POSE_INDEX else None


def _along(pem: DetectorModel, rows: FloatArray, column: int | None) -> FloatArray:
    """Logit ``[n]`` of rows ``[n, 11]`` that differ in a ``column`` alone, if in one."""
    if column is None or type(pem) is not NetworkPem:
        return pem.logit(rows)
    along = rows[:, column]
    low, high = float(along.min()), float(along.max())
    bends = kinks(pem, rows[0], column=column, low=low, high=high)
    at_kinks = np.repeat(rows[:1], bends.size, axis=0)
    at_kinks[:, column] = bends
    return np.interp(along, bends, pem.logit(at_kinks))


def _mean_along(pem: EnsemblePem, rows: FloatArray) -> FloatArray:
    column = _varying_pose(rows)
    logits = np.stack([_along(member, rows, column) for member in pem.members], axis=1)
    return map_rows(mean_probability_logit, logits)


def kinks(pem: NetworkPem, row: FloatArray, *, column: int, low: float, high: float) -> FloatArray:
    """Where the logit bends as one pose variable goes from ``low`` to ``high``, both included.

    Args:
        pem: The network.
        row: Salient variables ``[11]``, of which the others are held.
        column: The pose variable's.
        low: From where.
        high: To where, the last of the answer, ascending ``[k]``.
    """
    at_zero = np.array(row, dtype=np.float64)
    at_zero[column] = 0.0
    offset = paper_inputs(at_zero[None], pose_mean=pem.pose_mean, pose_std=pem.pose_std)
    slope = np.zeros_like(offset)
    pose = POSE_INDEX.index(column)
    slope[len(slope) - len(POSE_INDEX) + pose] = 1.0 / pem.pose_std[pose]
    edges = np.array([low, high])
    for layer in pem.layers[:-1]:
        slope, offset = layer.weight @ slope, layer.weight @ offset + layer.bias[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -offset / slope  # of each unit, if it keeps on as in each piece
        inside = (crossing > edges[:-1]) & (crossing < edges[1:])
        finer = np.unique(np.concatenate([edges, crossing[inside]]))
        middle = 0.5 * (finer[:-1] + finer[1:])
        piece = np.clip(np.searchsorted(edges, middle) - 1, 0, edges.size - 2)
        slope, offset = slope[:, piece], offset[:, piece]
        active = slope * middle + offset > 0.0
        slope, offset, edges = slope * active, offset * active, finer
    return edges
