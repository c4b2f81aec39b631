"""Proposals without anything to learn."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.types import CERTAIN, StateBatch


@dataclass(frozen=True)
class PemProposal:
    """Samples from the perception error model itself: plain Monte Carlo."""

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:  # noqa: ARG002
        """The model's own logit ``[...]``."""
        return pem_logit

    def arrays(self) -> Mapping[str, AnyArray]:
        """No parameters."""
        return {}


@dataclass(frozen=True)
class ConstantProposal:
    """Detects with the same probability everywhere but where the outcome is certain."""

    detection_probability: float

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """The constant's logit, ``[...]``."""
        probability = self.detection_probability
        logit = np.full_like(pem_logit, float(np.log(probability) - np.log1p(-probability)))
        if CERTAIN in states.memory:
            return np.where(states.memory[CERTAIN], pem_logit, logit)
        return logit

    def arrays(self) -> Mapping[str, AnyArray]:
        """The probability, a scalar."""
        return {"detection_probability": np.array(self.detection_probability)}
