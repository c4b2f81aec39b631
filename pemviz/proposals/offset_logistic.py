"""A generalised linear proposal: the error model's logit plus a polynomial of the state."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.proposals.defensive_share import defended
from pemviz.proposals.latent_means import LatentMeans
from pemviz.types import CERTAIN, Signal, StateBatch

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
        shape = (*columns[0].shape, len(columns) + 1)
        values = np.empty(shape, dtype=np.float64)
        for index, column in enumerate((*columns, states.step * 1.0)):
            values[..., index] = column
        return values

    def reacts(self, states: StateBatch) -> BoolArray:
        """True everywhere."""
        like = states.signals[self.signals[0].name]
        return np.ones_like(like, dtype=np.bool)


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

    @cached_property
    def exponents(self) -> tuple[tuple[int, ...], ...]:
        """Feature indices that are multiplied in each of the ``B`` monomials."""
        features = range(len(self.mean))
        return tuple(
            chosen
            for order in range(self.degree + 1)
            for chosen in itertools.combinations_with_replacement(features, order)
        )

    def evaluate(self, values: FloatArray) -> FloatArray:
        """Monomials ``[n, B]`` of features ``[n, D]``, standardised and kept within +-3."""
        standard = ((values - self.mean) / self.spread).clip(-STANDARD_RANGE, STANDARD_RANGE)
        shape = (values.shape[0], len(self.exponents))
        result = np.ones(shape, dtype=values.dtype)
        by_monomial, by_feature = result.T, standard.T
        for column, (lower, feature) in enumerate(self.factors, start=1):
            np.multiply(by_monomial[lower], by_feature[feature], out=by_monomial[column])
        return result

    @cached_property
    def factors(self) -> tuple[tuple[int, int], ...]:
        """Of each monomial but the constant, the one it is a feature times, and the feature."""
        place = {chosen: column for column, chosen in enumerate(self.exponents)}
        return tuple((place[chosen[:-1]], chosen[-1]) for chosen in self.exponents[1:])


@dataclass(frozen=True, eq=False)
class OffsetLogisticProposal:
    """logit q(miss) = logit p(miss) + clip(basis . coefficients), mixed with p at every step.

    Where the scenario does not react, or has violated already, it is the error model. A
    polynomial may be very sure where it has seen little; the mixture bounds what that costs.

    Attributes:
        features: What is looked at.
        basis: Monomials of it.
        coefficients: ``[B]``; or ``[N, B]``, for N rollouts a row each.
        violated: Name of the memory that says whether a rollout has violated already.
        defensive: Share of the error model in every outcome's probability.
        means: How it moves latents, where there are any.
    """

    features: StateFeatures
    basis: PolynomialBasis
    coefficients: FloatArray
    violated: str
    defensive: float
    means: LatentMeans | None = None

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]``."""
        acts = acting(self.features, states, pem_logit.shape, violated=self.violated)
        return self.logit_where(acts, states, pem_logit)

    def logit_where(self, acts: BoolArray, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """The same, of which ``acts [...]`` says where it leaves the error model."""
        values = _filling(self.features.values(states), (*pem_logit.shape, len(self.basis.mean)))
        values = values[acts]
        result = np.asarray(pem_logit, copy=True)
        under_pem = pem_logit[acts]
        by_row = self.coefficients.ndim > 1
        coefficients = self.coefficients[acts] if by_row else self.coefficients
        logit = under_pem - shift(self.basis.evaluate(values), coefficients)
        result[acts] = defended(logit, under_pem, share=self.defensive)
        return result

    def arrays(self) -> Mapping[str, AnyArray]:
        """Coefficients and standardisation, and means of latents."""
        return {
            "coefficients": self.coefficients,
            "mean": self.basis.mean,
            "spread": self.basis.spread,
            "degree": np.array(self.basis.degree),
            "defensive": np.array(self.defensive),
            **({} if self.means is None else self.means.arrays()),
        }


def shift(basis: FloatArray, coefficients: FloatArray) -> FloatArray:
    """How much the logit of a miss is raised ``[n]``, for monomials ``[n, B]``.

    Coefficients are ``[B]`` or, a row each, ``[n, B]``.
    """
    # einsum, unlike a library's matrix product, gives a row the same in any batch
    products = "nb,nb->n" if coefficients.ndim > 1 else "nb,b->n"
    raised = np.einsum(products, basis, coefficients)
    return raised.clip(-LARGEST_SHIFT, LARGEST_SHIFT)


def acting(
    features: StateFeatures, states: StateBatch, shape: tuple[int, ...], *, violated: str
) -> BoolArray:
    """Where a proposal may leave the error model: ``shape``."""
    acts = features.reacts(states)
    for over in (violated, CERTAIN):
        if over in states.memory:
            acts = acts & ~states.memory[over]
    return _filling(acts, shape)


def _filling(values: Any, shape: tuple[int, ...]) -> Any:
    """The values, broadcast where their shape is not yet ``shape``."""
    return values if values.shape == shape else np.broadcast_to(values, shape)
