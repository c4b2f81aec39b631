"""Proposals without anything to learn."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from pemviz.arrays import AnyArray, FloatArray, Move, namespace
from pemviz.types import CERTAIN, StateBatch


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
    """Detects with the same probability everywhere but where the outcome is certain."""

    detection_probability: float

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """The constant's logit, ``[...]``."""
        probability, xp = self.detection_probability, namespace(pem_logit)
        logit = xp.full_like(pem_logit, float(np.log(probability) - np.log1p(-probability)))
        if CERTAIN in states.memory:
            return xp.where(states.memory[CERTAIN], pem_logit, logit)
        return logit

    def moved(self, move: Move) -> Self:  # noqa: ARG002
        """Itself: it holds no arrays."""
        return self

    def arrays(self) -> Mapping[str, AnyArray]:
        """The probability, a scalar."""
        return {"detection_probability": np.array(self.detection_probability)}
