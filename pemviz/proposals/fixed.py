"""Proposals without anything to learn."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from pemviz.arrays import AnyArray, FloatArray, Move, namespace
from pemviz.types import StateBatch


@dataclass(frozen=True)
class PemProposal:
    """Samples from the perception error model itself: plain Monte Carlo."""

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:  # noqa: ARG002
        """The model's own logit ``[...]``."""
        return pem_logit

    def moved(self, move: Move) -> Self:  # noqa: ARG002
        """Itself: it holds no arrays."""
        return self

    def arrays(self) -> Mapping[str, AnyArray]:
        """No parameters."""
        return {}


@dataclass(frozen=True)
class ConstantProposal:
    """Detects with the same probability everywhere."""

    detection_probability: float

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:  # noqa: ARG002
        """The constant's logit, ``[...]``."""
        probability = self.detection_probability
        logit = float(np.log(probability) - np.log1p(-probability))
        return namespace(pem_logit).full_like(pem_logit, logit)

    def moved(self, move: Move) -> Self:  # noqa: ARG002
        """Itself: it holds no arrays."""
        return self

    def arrays(self) -> Mapping[str, AnyArray]:
        """The probability, a scalar."""
        return {"detection_probability": np.array(self.detection_probability)}
