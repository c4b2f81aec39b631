"""A detector model of the user's own as a perception error model."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.pem.models.protocol import Pem


@runtime_checkable
class DetectorModel(Protocol):
    """How likely a detector is to detect: all that a run needs to know of it."""

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of P(detected), shape ``[...]``, of salient variables, shape ``[..., D]``.

        A row's answer must not depend on the batch it comes in.
        """
        ...


@dataclass(frozen=True)
class OwnPem:
    """A detector model with what results say about a perception error model.

    Attributes:
        detector: The user's model.
        name: For result files and legends.
        digest: Nothing: a hash of code says nothing about what it answers.
        data: What the model rests on, in words.
        licence: Terms of its use.
    """

    detector: DetectorModel
    name: str
    digest: str = ""
    data: str = "not stated: a model of the user's own"
    licence: str = "not stated"

    def logit(self, salient: FloatArray) -> FloatArray:
        """The model's own answer, shape ``[...]``, for salient variables ``[..., D]``."""
        return self.detector.logit(salient)


def as_pem(detector: DetectorModel) -> Pem:
    """``detector`` itself if it says all that a perception error model says, else wrapped.

    A wrapped model is named after its class.

    Raises:
        PemError: It has no method ``logit``.
    """
    if isinstance(detector, Pem):
        return detector
    if isinstance(detector, type) or not callable(getattr(detector, "logit", None)):
        message = f"pem = {type(detector).__name__}: needs a method logit(salient)"
        raise PemError(message)
    return OwnPem(detector=detector, name=type(detector).__name__)
