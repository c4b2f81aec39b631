"""Feed-forward networks on the paper's 14 inputs, evaluated in double precision by numpy.

Logistic regression is a network without hidden layers, guessing the mean one whose weights are 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, FloatArray
from pemviz.chunks import map_rows
from pemviz.errors import PemError
from pemviz.pem.models.card import Carded, PemCard
from pemviz.pem.models.encoding import PAPER_INPUTS, POSE_COLUMNS, check_rows, paper_inputs
from pemviz.pem.models.layers import COLUMNS, Layer, forward
from pemviz.pem.models.protocol import as_rows
from pemviz.pem.models.tensors import check_finite, tensors_digest

FARTHEST = 1e6
"""Far beyond any x, y, z [m] or angle [rad] that a scenario holds."""


@dataclass(frozen=True, eq=False)
class NetworkPem(Carded):
    """A network with rectified hidden layers and one output, the logit of P(detected)."""

    kind: ClassVar[str] = "network"

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
        if not np.isfinite(largest_output(self)):
            raise PemError(f"{self.card.name}: its numbers are so large that answers overflow")

    @property
    def digest(self) -> str:
        """SHA-256 of the tensors."""
        return tensors_digest(self.kind, self.tensors())

    def tensors(self) -> dict[str, AnyArray]:
        """Everything that decides the answers, by the names used in files."""
        named: dict[str, AnyArray] = {"pose.mean": self.pose_mean, "pose.std": self.pose_std}
        for index, layer in enumerate(self.layers):
            named[f"layers.{index}.weight"] = layer.weight
            named[f"layers.{index}.bias"] = layer.bias
        return named

    def options(self) -> dict[str, Any]:
        """What a file must say beside the tensors: the inputs in order."""
        return {"inputs": list(PAPER_INPUTS)}

    def logit(self, salient: ArrayLike) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables [..., 11]."""
        rows, shape = as_rows(salient)
        check_rows(rows)
        return map_rows(self._answer, rows, padded=False).reshape(shape)

    def _answer(self, rows: FloatArray) -> FloatArray:
        inputs = paper_inputs(
            rows, pose_mean=self.pose_mean, pose_std=self.pose_std, multiple=COLUMNS
        )
        return forward(self.layers, inputs)[: len(rows)]


def largest_output(pem: "NetworkPem") -> float:
    """A bound on |logit| for obstacles within FARTHEST of 0 in each pose variable."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        pose = (FARTHEST + np.abs(pem.pose_mean)) / pem.pose_std
        reach = np.concatenate([np.ones(len(PAPER_INPUTS) - len(POSE_COLUMNS)), pose])
        for layer in pem.layers:
            reach = np.abs(layer.weight) @ reach + np.abs(layer.bias)
    return float(reach[0])


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
