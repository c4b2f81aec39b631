"""What networks are made of, and how numpy evaluates it in double precision."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pemviz.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Layer:
    """An affine map."""

    weight: FloatArray
    """Shape [outputs, inputs]."""
    bias: FloatArray
    """Shape [outputs]."""


def forward(layers: Sequence[Layer], inputs: FloatArray) -> FloatArray:
    """Output [n] of a rectified network on inputs [features, n].

    numpy's own einsum adds up feature by feature, vectorised over n: unlike a matrix product of
    the linear algebra library, what one column gives cannot depend on the others or on threads,
    nor, while there are several, on how many they are.
    """
    hidden = inputs
    zero = np.zeros((), dtype=inputs.dtype)
    for layer in layers[:-1]:
        hidden = np.einsum("hk,kn->hn", layer.weight, hidden)
        hidden += layer.bias[:, None]
        np.maximum(hidden, zero, out=hidden)
    return np.einsum("hk,kn->hn", layers[-1].weight, hidden)[0] + layers[-1].bias[0]


class PackedNetwork(NamedTuple):
    """A network as the loop takes it.

    Attributes:
        pose_mean: Of the pose columns in training, ``[4]``.
        pose_std: Their standard deviations.
        numbers: Of each layer the weights, row by row, then the biases.
        sizes: Inputs, units of each hidden layer, 1.
    """

    pose_mean: FloatArray
    pose_std: FloatArray
    numbers: FloatArray
    sizes: IntArray


def packed(pose_mean: FloatArray, pose_std: FloatArray, layers: Sequence[Layer]) -> PackedNetwork:
    """A network's numbers in one piece."""
    pieces = [part.ravel() for layer in layers for part in (layer.weight, layer.bias)]
    sizes = [layers[0].weight.shape[1], *(layer.weight.shape[0] for layer in layers)]
    return PackedNetwork(
        *(np.array(values, dtype=np.float64) for values in (pose_mean, pose_std)),
        numbers=np.concatenate(pieces, dtype=np.float64),
        sizes=np.array(sizes, dtype=np.int64),
    )
