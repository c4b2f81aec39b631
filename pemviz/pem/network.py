"""Feed-forward networks on the paper's 14 inputs, evaluated in double precision by numpy.

Linear regression is a network without hidden layers, guessing the mean one whose weights are 0.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, FloatArray, read_only
from pemviz.pem.card import PemCard
from pemviz.pem.encoding import PAPER_INPUTS, POSE_COLUMNS, check_rows, paper_inputs
from pemviz.pem.errors import PemError
from pemviz.pem.protocol import as_rows

CHUNK_ROWS = 128
"""Rows evaluated at once; a multiple of every vector register's length."""


@dataclass(frozen=True)
class Layer:
    """An affine map."""

    weight: FloatArray
    """Shape [outputs, inputs]."""
    bias: FloatArray
    """Shape [outputs]."""


@dataclass(frozen=True, eq=False)
class NetworkPem:
    """A network with rectified hidden layers and one output, the logit of P(detected)."""

    card: PemCard
    pose_mean: FloatArray
    """Training means of x, y, z [m] and rotation_y [rad], shape [4]."""
    pose_std: FloatArray
    """Their standard deviations, shape [4]."""
    layers: tuple[Layer, ...]
    """Hidden layers, then the output layer."""

    def __post_init__(self) -> None:
        """Refuse what cannot be evaluated.

        Raises:
            PemError: a shape does not fit its neighbours, or a number is not finite.
        """
        check_finite(self.tensors(), where=self.card.name)
        pose = (len(POSE_COLUMNS),)
        if self.pose_mean.shape != pose or self.pose_std.shape != pose:
            raise PemError(f"{self.card.name}: pose mean and deviation need shape {list(pose)}")
        if not (self.pose_std > 0.0).all():
            raise PemError(f"{self.card.name}: pose standard deviations must be above 0")
        check_layers(self.layers, where=self.card.name)

    @property
    def name(self) -> str:
        """Short name."""
        return self.card.name

    @property
    def data(self) -> str:
        """What it was trained on."""
        return self.card.data

    @property
    def licence(self) -> str:
        """Terms of use."""
        return self.card.licence

    @property
    def digest(self) -> str:
        """SHA-256 of the tensors."""
        return tensors_digest("network", self.tensors())

    def tensors(self) -> dict[str, AnyArray]:
        """Everything that decides the answers, by the names used in files."""
        named: dict[str, AnyArray] = {"pose.mean": self.pose_mean, "pose.std": self.pose_std}
        for index, layer in enumerate(self.layers):
            named[f"layers.{index}.weight"] = layer.weight
            named[f"layers.{index}.bias"] = layer.bias
        return named

    def logit(self, salient: ArrayLike) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables [..., 11]."""
        rows, shape = as_rows(salient)
        check_rows(rows)
        return in_chunks(rows, self._logit_of_chunk).reshape(shape)

    def _logit_of_chunk(self, rows: FloatArray) -> FloatArray:
        hidden = paper_inputs(rows, pose_mean=self.pose_mean, pose_std=self.pose_std)
        return forward(self.layers, hidden)


def forward(layers: Sequence[Layer], inputs: FloatArray) -> FloatArray:
    """Output [n] of a rectified network on inputs [features, n].

    numpy's own einsum adds up feature by feature, vectorised over n: unlike a matrix product of
    the linear algebra library, what one column gives cannot depend on the others or on threads.
    """
    hidden = inputs
    for layer in layers[:-1]:
        hidden = np.einsum("hk,kn->hn", layer.weight, hidden)
        hidden += layer.bias[:, None]
        np.maximum(hidden, 0.0, out=hidden)
    return np.einsum("hk,kn->hn", layers[-1].weight, hidden)[0] + layers[-1].bias[0]


def in_chunks(rows: FloatArray, evaluate: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Apply ``evaluate`` to rows [n, 11] in chunks of CHUNK_ROWS, the last one padded.

    The size of a batch therefore never reaches the last digit of an answer.
    """
    result = np.empty(len(rows))
    for start in range(0, len(rows), CHUNK_ROWS):
        chunk = rows[start : start + CHUNK_ROWS]
        count = len(chunk)
        if count < CHUNK_ROWS:
            padded = np.empty((CHUNK_ROWS, rows.shape[1]))
            padded[:count] = chunk
            padded[count:] = chunk[-1]
            chunk = padded
        result[start : start + count] = evaluate(chunk)[:count]
    return result


def check_layers(layers: Sequence[Layer], *, where: str) -> None:
    """Refuse layers whose shapes do not form a network from the paper's inputs to one output.

    Raises:
        PemError: what is wrong, in one line.
    """
    if not layers:
        raise PemError(f"{where}: the network has no layers")
    for index, layer in enumerate(layers):
        if layer.weight.ndim != 2 or layer.bias.shape != layer.weight.shape[:1]:
            raise PemError(
                f"{where}: layer {index} has weight {list(layer.weight.shape)} "
                f"and bias {list(layer.bias.shape)}"
            )
    for index, (before, after) in enumerate(pairwise(layers)):
        if after.weight.shape[1] != before.weight.shape[0]:
            raise PemError(
                f"{where}: layer {index + 1} takes {after.weight.shape[1]} inputs, "
                f"layer {index} gives {before.weight.shape[0]}"
            )
    inputs, outputs = layers[0].weight.shape[1], layers[-1].weight.shape[0]
    if inputs != len(PAPER_INPUTS) or outputs != 1:
        raise PemError(
            f"{where}: the network maps {inputs} inputs to {outputs}, "
            f"it must map {len(PAPER_INPUTS)} to 1"
        )


def check_finite(tensors: dict[str, AnyArray], *, where: str) -> None:
    """Refuse tensors with NaN or infinity.

    Raises:
        PemError: naming the first such tensor.
    """
    for name in sorted(tensors):
        if not np.isfinite(tensors[name]).all():
            raise PemError(f"{where}: tensor {name!r} holds values that are not finite")


def tensors_digest(kind: str, tensors: dict[str, AnyArray]) -> str:
    """SHA-256 (hex) over a model's kind and its tensors: names, types, shapes and bytes."""
    digest = hashlib.sha256(kind.encode())
    for name in sorted(tensors):
        array = np.ascontiguousarray(tensors[name])
        digest.update(f"|{name}|{array.dtype.str}|{list(array.shape)}|".encode())
        digest.update(read_only(array).tobytes())
    return digest.hexdigest()
