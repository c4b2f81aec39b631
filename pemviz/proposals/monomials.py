"""Monomials of many decisions, made when some of them are asked for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import Batch, BoolArray, FloatArray, Rows
from pemviz.proposals.offset_logistic import PolynomialBasis, StateFeatures
from pemviz.types import StateBatch

NOISE_DEGREE = 2
"""Of the polynomial that gives means of noise."""
MADE_AT_ONCE = 4_096
"""Decisions: as many as a processor's cache holds with their monomials."""
ROLLOUTS_AT_ONCE = 250
"""Of many, whose decisions' monomials are made."""


@dataclass(frozen=True)
class Monomials(Batch):
    """Monomials ``[M, B]`` in the memory of the features that they are made of, a sixth of theirs.

    Attributes:
        features: ``[M, D]``.
        basis: What they are monomials of.
    """

    features: FloatArray
    basis: PolynomialBasis

    def __getitem__(self, rows: Rows) -> FloatArray:
        """Those of some decisions, ``[m, B]``."""
        features = self.features[rows]
        found = np.empty((len(features), len(self.basis.exponents)))
        for first in range(0, len(found), MADE_AT_ONCE):
            some = slice(first, first + MADE_AT_ONCE)
            found[some] = self.basis.evaluate(features[some])
        return found

    def joined(self, after: "Monomials") -> "Monomials":
        """These decisions and more."""
        return Monomials.concatenate([self, after])

    @classmethod
    def _beside_rows(cls, batches: Sequence[Any]) -> Mapping[str, Any]:
        return {"basis": batches[0].basis}


def some_at_once(count: int) -> list[int]:
    """Edges of ``count`` rollouts in pieces that their monomials are made of."""
    return [*range(0, max(count, 1), ROLLOUTS_AT_ONCE), count]


def noise_basis(basis: PolynomialBasis) -> PolynomialBasis:
    """Monomials for the means of noise, of what outcomes look at and of the outcome itself.

    A step's noise is drawn after its outcomes: an error of a position may matter with a detection
    alone.
    """
    return PolynomialBasis(
        mean=np.append(basis.mean, 0.5),
        spread=np.append(basis.spread, 0.5),
        degree=min(basis.degree, NOISE_DEGREE),
    )


def noise_features(features: StateFeatures, states: StateBatch, detected: BoolArray) -> FloatArray:
    """Features of states ``[...]`` and outcomes there, ``[..., D + 1]``."""
    values = features.values(states)
    values = np.broadcast_to(values, (*detected.shape, values.shape[-1]))
    return np.concatenate([values, detected[..., None]], axis=-1, dtype=np.float64)
