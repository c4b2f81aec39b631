"""A generalised linear proposal: the error model's logit plus a polynomial of the state."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.proposals.defensive_share import defended
from pemviz.types import Signal, StateBatch

STANDARD_RANGE = 3.0
LARGEST_SHIFT = 12.0


class StateFeatures(Protocol):
    """What a scenario offers a proposal to look at."""

    def values(self, states: StateBatch) -> FloatArray:
        """Numbers ``[..., D]`` that describe states ``[...]``."""
        ...

    def reacts(self, states: StateBatch) -> BoolArray:
        """Whether perception's outcome may matter at states ``[...]``; True if unknown."""
        ...


@dataclass(frozen=True)
class SignalFeatures:
    """All signals and the step: what any scenario has."""

    signals: tuple[Signal, ...]

    def values(self, states: StateBatch) -> FloatArray:
        """Signals in their order, then the step, ``[..., D]``."""
        columns = [states.signals[signal.name] for signal in self.signals]
        step = np.broadcast_to(states.step, columns[0].shape).astype(np.float64)
        return np.stack([*columns, step], axis=-1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """True everywhere."""
        return np.ones(states.signals[self.signals[0].name].shape, dtype=np.bool_)


@dataclass(frozen=True)
class PolynomialBasis:
    """All monomials of standardised features up to a degree, the constant first.

    Attributes:
        mean: Of each feature, ``[D]``.
        spread: Of each feature, above 0, ``[D]``.
        degree: Largest total degree.
    """

    mean: FloatArray
    spread: FloatArray
    degree: int

    @property
    def exponents(self) -> tuple[tuple[int, ...], ...]:
        """Feature indices that are multiplied in each of the ``B`` monomials."""
        features = range(self.mean.size)
        return tuple(
            chosen
            for order in range(self.degree + 1)
            for chosen in itertools.combinations_with_replacement(features, order)
        )

    def evaluate(self, values: FloatArray) -> FloatArray:
        """Monomials ``[n, B]`` of features ``[n, D]``, standardised and kept within +-3."""
        standard = np.clip((values - self.mean) / self.spread, -STANDARD_RANGE, STANDARD_RANGE)
        result = np.ones((values.shape[0], len(self.exponents)))
        for column, chosen in enumerate(self.exponents):
            for feature in chosen:
                result[:, column] *= standard[:, feature]
        return result


@dataclass(frozen=True, eq=False)
class OffsetLogisticProposal:
    """logit q(miss) = logit p(miss) + clip(basis . coefficients), mixed with p at every step.

    Where the scenario does not react, or has violated already, it is the error model. A
    polynomial may be very sure where it has seen little; the mixture bounds what that costs.

    Attributes:
        features: What is looked at.
        basis: Monomials of it.
        coefficients: ``[B]``.
        violated: Name of the memory that says whether a rollout has violated already.
        defensive: Share of the error model in every outcome's probability.
    """

    features: StateFeatures
    basis: PolynomialBasis
    coefficients: FloatArray
    violated: str
    defensive: float

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]``."""
        shape = pem_logit.shape
        acts = acting(self.features, states, shape, violated=self.violated)
        values = np.broadcast_to(self.features.values(states), (*shape, self.basis.mean.size))[acts]
        result = pem_logit.copy()
        under_pem = pem_logit[acts]
        logit = under_pem - shift(self.basis.evaluate(values), self.coefficients)
        result[acts] = defended(logit, under_pem, share=self.defensive)
        return result

    def arrays(self) -> Mapping[str, AnyArray]:
        """Coefficients and standardisation."""
        return {
            "coefficients": self.coefficients,
            "mean": self.basis.mean,
            "spread": self.basis.spread,
            "degree": np.array(self.basis.degree),
            "defensive": np.array(self.defensive),
        }


def shift(basis: FloatArray, coefficients: FloatArray) -> FloatArray:
    """How much the logit of a miss is raised ``[n]``, for monomials ``[n, B]``."""
    # einsum, unlike a library's matrix product, gives a row the same in any batch
    raised = np.einsum("nb,b->n", basis, coefficients)
    return np.clip(raised, -LARGEST_SHIFT, LARGEST_SHIFT)


def acting(
    features: StateFeatures, states: StateBatch, shape: tuple[int, ...], *, violated: str
) -> BoolArray:
    """Where a proposal may leave the error model: ``shape``."""
    before = np.asarray(states.memory.get(violated, np.False_), dtype=np.bool_)
    return np.broadcast_to(features.reacts(states) & ~before, shape)
