"""What networks are made of, and how numpy evaluates it in double precision."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray

COLUMNS = 8
"""Rows are answered in multiples of so many, so that none is rounded otherwise for being last."""


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
