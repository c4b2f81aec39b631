"""What a perception error model is to the rest of the project, and what one answers for."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, BoolArray, FloatArray, row_sums, softplus
from pemviz.errors import PemError

SALIENT_COLUMNS = (
    *("class_id", "truncation", "occlusion", "alpha_rad", "height_m", "width_m", "length_m"),
    *("x_m", "y_m", "z_m", "rotation_y_rad"),
)
"""The salient variables of an obstacle in KITTI's order; camera frame x right, y down, z forward.

``class_id`` indexes CLASS_NAMES, ``occlusion`` indexes OCCLUSION_NAMES, ``truncation`` is in
[0, 1], the location is the centre of the bottom face of the obstacle's box.
"""

CLASS_NAMES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram")
OCCLUSION_NAMES = ("none", "partly", "largely")

COLUMN = {name: index for index, name in enumerate(SALIENT_COLUMNS)}
"""Index of each salient column."""

_KIND, _OCCLUSION = COLUMN["class_id"], COLUMN["occlusion"]
_CODED = slice(_KIND, _OCCLUSION + 1, _OCCLUSION - _KIND)  # these two


@runtime_checkable
class DetectorModel(Protocol):
    """How likely a detector is to detect: all that a run needs to know of it."""

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables, shape [..., 11].

        A row's answer is the same to the last bit in whatever batch it comes.
        """
        ...


@runtime_checkable
class Pem(DetectorModel, Protocol):
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


@dataclass(frozen=True)
class OwnPem:
    """A detector model of the user's own with what results say about a perception error model."""

    detector: DetectorModel
    name: str
    digest: str = ""
    """Nothing: a hash of code says nothing about what it answers."""
    data: str = "data that it does not name (a model of the user's own)"
    licence: str = "not stated"

    def logit(self, salient: FloatArray) -> FloatArray:
        """The model's own answer, shape ``[...]``, for salient variables ``[..., D]``."""
        return self.detector.logit(salient)

    @property
    def memory(self) -> object:
        """How its misses hang together, if it says so; see ``pemviz.pem.memory_of``."""
        return getattr(self.detector, "memory", None)

    @property
    def varying_frailty(self) -> object:
        """How its visibility comes and goes; see ``pemviz.pem.models.cards.varying_frailty_of``."""
        return getattr(self.detector, "varying_frailty", None)


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
        logit_of: How a model without memory is evaluated; its own ``logit`` by default.
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


def check_rows(rows: FloatArray) -> None:
    """Refuse salient variables [n, 11] that no model here was made for.

    Raises:
        PemError: a value is not finite, or a class or occlusion level is unknown.
    """
    if not np.isfinite(rows).all():
        row, column = np.argwhere(~np.isfinite(rows))[0]
        raise PemError(f"salient row {row}: {SALIENT_COLUMNS[column]} is {rows[row, column]}")
    if not len(rows):
        return
    coded = rows[:, _CODED]
    kind, occlusion = coded[0].tolist()
    known = kind in range(len(CLASS_NAMES)) and occlusion in range(len(OCCLUSION_NAMES))
    if known and (coded == coded[0]).all():  # all of one kind, as in most scenarios
        return
    for name, allowed in (("class_id", CLASS_NAMES), ("occlusion", OCCLUSION_NAMES)):
        values = rows[:, COLUMN[name]]
        wrong = (values < 0) | (values >= len(allowed)) | (values != np.floor(values))
        if wrong.any():
            row = int(np.argmax(wrong))
            labels = ", ".join(f"{index} {label}" for index, label in enumerate(allowed))
            raise PemError(f"salient row {row}: {name} is {values[row]:g}, allowed: {labels}")


def known_codes(rows: FloatArray) -> BoolArray:
    """Which of salient variables ``[n, 11]`` have a known class and occlusion level ``[n]``."""
    kinds, levels = (np.arange(len(names)) for names in (CLASS_NAMES, OCCLUSION_NAMES))
    return np.isin(rows[:, _KIND], kinds) & np.isin(rows[:, _OCCLUSION], levels)


def check_finite(tensors: Mapping[str, AnyArray], *, where: str) -> None:
    """Refuse tensors with NaN or infinity.

    Raises:
        PemError: naming the first such tensor.
    """
    for name in sorted(tensors):
        if not np.isfinite(tensors[name]).all():
            raise PemError(f"{where}: tensor {name!r} holds values that are not finite")


def as_double(array: AnyArray) -> FloatArray:
    """The numbers in double precision; what is no number stays none, without a warning."""
    with np.errstate(invalid="ignore"):
        return np.asarray(array, dtype=np.float64)


def tensors_digest(kind: str, tensors: Mapping[str, AnyArray]) -> str:
    """SHA-256 (hex) over a model's kind and its tensors: names, types, shapes and bytes."""
    digest = hashlib.sha256(kind.encode())
    for name in sorted(tensors):
        array = np.ascontiguousarray(tensors[name])
        digest.update(f"|{name}|{array.dtype.str}|{list(array.shape)}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
