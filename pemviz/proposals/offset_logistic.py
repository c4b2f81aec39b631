"""A generalised linear proposal: the error model's logit plus a polynomial of the state.

At every outcome it is mixed with the error model (defensive mixture: Hesterberg 1995).
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from pemviz.arrays import AnyArray, Batch, BoolArray, FloatArray, Rows
from pemviz.proposals.defensive import defended
from pemviz.types import CERTAIN, Signal, StateBatch

STANDARD_RANGE = 3.0
LARGEST_SHIFT = 12.0
NOISE_DEGREE = 2
"""Of the polynomial that gives means of noise."""
MADE_AT_ONCE = 4_096
"""Decisions: as many as a processor's cache holds with their monomials."""
ROLLOUTS_AT_ONCE = 250
"""Of many, whose decisions' monomials are made."""


def outcome_ratios(
    miss_logit: FloatArray, missed: BoolArray, *, share: float
) -> Callable[[FloatArray], FloatArray]:
    """How much likelier outcomes ``[M]`` are under mixtures with proposals than by the error model.

    An outcome of logit a under the model and a + d under a proposal is (1 + e^-a) / (1 + e^-(a+d))
    times as likely under the latter. With E = e^-|a| that is (1 + E) / (1 + E e^-d) where a > 0,
    else (1 + E) / (E + e^-d): nothing overflows.

    Args:
        miss_logit: The error model's logits of a miss, ``[M]``.
        missed: The outcomes, ``[M]``.
        share: Of the error model, in (0, 1).

    Returns:
        Gives log q / p of each outcome, ``[M]``, for how much misses' logits are raised, ``[M]``.
    """
    sign = np.where(missed, 1.0, -1.0)
    model = sign * miss_logit
    small, likely = np.exp(-np.abs(model)), model > 0.0
    fixed, moved = np.where(likely, 1.0, small), np.where(likely, small, 1.0)
    scale = (1.0 - share) * (1.0 + small)

    def log_ratio(raised: FloatArray) -> FloatArray:
        denominator = np.exp(-sign * raised)
        denominator *= moved
        denominator += fixed
        ratio = np.divide(scale, denominator, out=denominator)
        ratio += share
        return np.log(ratio, out=ratio)

    return log_ratio


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
        return np.ones_like(states.signals[self.signals[0].name], dtype=np.bool)


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

    @staticmethod
    def standardised_by(values: FloatArray, *, degree: int) -> "PolynomialBasis":
        """By features ``[n, D]``; a constant one, and all of no rows, keep spread 1."""
        if values.shape[0] == 0:
            return PolynomialBasis(np.zeros(values.shape[1]), np.ones(values.shape[1]), degree)
        spread = np.std(values, axis=0)
        return PolynomialBasis(np.mean(values, axis=0), np.where(spread > 0.0, spread, 1.0), degree)

    def with_outcome(self) -> "PolynomialBasis":
        """Monomials for the means of noise, of what outcomes look at and of the outcome itself.

        A step's noise is sampled after its outcomes: an error of a position may matter with a
        detection alone.
        """
        mean, spread = np.append(self.mean, 0.5), np.append(self.spread, 0.5)
        return PolynomialBasis(mean, spread, min(self.degree, NOISE_DEGREE))

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

    @classmethod
    def _beside_rows(cls, batches: Sequence[Any]) -> Mapping[str, Any]:
        return {"basis": batches[0].basis}


def some_at_once(count: int) -> list[int]:
    """Edges of ``count`` rollouts in pieces that their monomials are made of."""
    return [*range(0, max(count, 1), ROLLOUTS_AT_ONCE), count]


def noise_features(features: StateFeatures, states: StateBatch, detected: BoolArray) -> FloatArray:
    """Features of states ``[...]`` and outcomes there, ``[..., D + 1]``."""
    values = features.values(states)
    values = np.broadcast_to(values, (*detected.shape, values.shape[-1]))
    return np.concatenate([values, detected[..., None]], axis=-1, dtype=np.float64)


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
        defensive: Share of the error model in every outcome's probability; of N rollouts each its
            own, ``[N]``.
        by_step: By how much it raises a miss's logit at each step besides, ``[T-1]`` or
            ``[N, T-1]``; ``None``: by nothing.
        latents: What is stored beside it of how latents are moved.
    """

    features: StateFeatures
    basis: PolynomialBasis
    coefficients: FloatArray
    violated: str
    defensive: float | FloatArray
    by_step: FloatArray | None = None
    latents: Mapping[str, AnyArray] = field(default_factory=dict[str, AnyArray])

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
        raised = shift(self.basis.evaluate(values), coefficients)
        if self.by_step is not None:
            step = np.broadcast_to(states.step, pem_logit.shape)
            of_row = (np.arange(len(step)), step) if self.by_step.ndim > 1 else step
            raised = raised + self.by_step[of_row][acts]
        logit = under_pem - raised
        share = self.defensive[acts] if isinstance(self.defensive, np.ndarray) else self.defensive
        result[acts] = defended(logit, under_pem, share=share)
        return result

    def arrays(self) -> Mapping[str, AnyArray]:
        """Coefficients and standardisation, and what moves latents."""
        return {
            "coefficients": self.coefficients,
            "mean": self.basis.mean,
            "spread": self.basis.spread,
            "degree": np.array(self.basis.degree),
            "defensive": np.array(self.defensive),
            **({} if self.by_step is None else {"by_step": self.by_step}),
            **self.latents,
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
