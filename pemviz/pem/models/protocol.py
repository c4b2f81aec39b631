"""What a perception error model is to the rest of the project."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import BoolArray, FloatArray, row_sums, softplus
from pemviz.errors import PemError

SALIENT_COLUMNS = (
    "class_id",
    "truncation",
    "occlusion",
    "alpha_rad",
    "height_m",
    "width_m",
    "length_m",
    "x_m",
    "y_m",
    "z_m",
    "rotation_y_rad",
)
"""The salient variables of an obstacle in KITTI's order; camera frame x right, y down, z forward.

``class_id`` indexes CLASS_NAMES, ``occlusion`` indexes OCCLUSION_NAMES, ``truncation`` is in
[0, 1], the location is the centre of the bottom face of the obstacle's box.
"""

CLASS_NAMES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram")
OCCLUSION_NAMES = ("none", "partly", "largely")

COLUMN = {name: index for index, name in enumerate(SALIENT_COLUMNS)}
"""Index of each salient column."""


@runtime_checkable
class Pem(Protocol):
    """A perception error model: P(detected) as a function of the salient variables."""

    @property
    def name(self) -> str:
        """Short name, for result files and legends."""
        ...

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of what decides the model's answers."""
        ...

    @property
    def data(self) -> str:
        """What the model was trained on, in words."""
        ...

    @property
    def licence(self) -> str:
        """Under which terms the model may be used."""
        ...

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables, shape [..., 11].

        A row's answer is the same to the last bit in whatever batch it comes.
        """
        ...


@runtime_checkable
class ChainPem(Pem, Protocol):
    """One whose P(detected) depends on the outcomes before as well."""

    def log_likelihood(self, salient: FloatArray, detected: BoolArray) -> FloatArray:
        """Log likelihood of all outcomes of rollouts, ``[N]`` [nats].

        Args:
            salient: What it sees, ``[N, T-1, D]``.
            detected: The outcomes, ``[N, T-1]``.
        """
        ...


def chain_log_likelihood(
    pem: Pem,
    salient: FloatArray,
    detected: BoolArray,
    *,
    logit_of: Callable[[Pem, FloatArray], FloatArray] | None = None,
) -> FloatArray:
    """Log likelihood of all outcomes of rollouts, ``[N]`` [nats], under any model.

    Args:
        pem: The model.
        salient: What it sees, ``[N, T-1, D]``.
        detected: The outcomes, ``[N, T-1]``.
        logit_of: How a model without memory is asked; its own ``logit`` by default.
    """
    if isinstance(pem, ChainPem):
        return pem.log_likelihood(salient, detected)
    logit = pem.logit(salient) if logit_of is None else logit_of(pem, salient)
    return -row_sums(softplus(np.where(detected, -logit, logit)))


@runtime_checkable
class PemEnsemble(Protocol):
    """Models that the same data could equally well have produced; at least two."""

    @property
    def name(self) -> str:
        """Short name of the whole ensemble."""
        ...

    @property
    def members(self) -> Sequence[Pem]:
        """The members, each a perception error model of its own."""
        ...


@dataclass(frozen=True)
class Refits:
    """An ensemble whose members are given."""

    name: str
    members: Sequence[Pem]


def as_rows(salient: ArrayLike) -> tuple[FloatArray, tuple[int, ...]]:
    """Flatten salient variables [..., 11] to rows [n, 11] and the leading shape.

    Raises:
        PemError: the last axis is not 11 long.
    """
    array = np.asarray(salient, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != len(SALIENT_COLUMNS):
        raise PemError(
            f"salient variables have shape {list(array.shape)}, need [..., {len(SALIENT_COLUMNS)}]"
        )
    return array.reshape(-1, len(SALIENT_COLUMNS)), array.shape[:-1]
