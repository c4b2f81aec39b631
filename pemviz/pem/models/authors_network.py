"""The published network of the paper's authors: a torch state dict in safetensors.

Keys ``ff_nn.{0,1,3,4,6}.*`` of Linear, BatchNorm, ReLU, Linear, BatchNorm, ReLU, Linear, and
``input_mean`` and ``input_std`` of the eleven raw columns.
"""

from collections.abc import Mapping

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import PemError
from pemviz.pem.models.card import UNKNOWN_LICENCE, PemCard
from pemviz.pem.models.encoding import POSE_INDEX
from pemviz.pem.models.layers import Layer
from pemviz.pem.models.network import NetworkPem
from pemviz.pem.models.protocol import SALIENT_COLUMNS
from pemviz.pem.models.tensors import as_double, check_finite

BATCH_NORM_EPSILON = 1e-5
"""torch's default, which the checkpoint does not carry."""

_LINEAR_AND_NORM = (("ff_nn.0", "ff_nn.1"), ("ff_nn.3", "ff_nn.4"))
_OUTPUT = "ff_nn.6"


def is_authors_checkpoint(tensors: Mapping[str, AnyArray]) -> bool:
    """Whether the tensors carry the authors' key names."""
    return any(name.startswith("ff_nn.") for name in tensors)


def fold_batch_norm(
    layer: Layer,
    *,
    scale: FloatArray,
    shift: FloatArray,
    mean: FloatArray,
    variance: FloatArray,
    epsilon: float = BATCH_NORM_EPSILON,
) -> Layer:
    """The affine map that equals ``layer`` followed by batch normalisation in evaluation mode.

    Args:
        layer: the affine map before the normalisation, [outputs, inputs].
        scale: learned factor, shape [outputs].
        shift: learned summand, shape [outputs].
        mean: running mean, shape [outputs].
        variance: running variance, shape [outputs].
        epsilon: what is added to the variance.
    """
    # what overflows is not finite, and the model refuses that
    with np.errstate(over="ignore", invalid="ignore"):
        factor = scale / np.sqrt(variance + epsilon)
        weight = layer.weight * factor[:, None]
        bias = (layer.bias - mean) * factor + shift
    return Layer(weight=weight, bias=bias)


def authors_pem(
    tensors: Mapping[str, AnyArray], *, name: str, where: str, source: str | None = None
) -> NetworkPem:
    """Build the model, batch normalisations folded, in double precision.

    Args:
        tensors: the checkpoint's tensors.
        name: the model's name.
        where: the file, for messages.
        source: where the checkpoint says that it comes from.

    Raises:
        PemError: a tensor is missing, has the wrong shape or is not finite.
    """
    doubles = {key: as_double(value) for key, value in tensors.items()}
    check_finite(doubles, where=where)
    layers: list[Layer] = []
    for linear, norm in _LINEAR_AND_NORM:
        layer = _layer(doubles, linear, where=where)
        size = len(layer.bias)
        if (_vector(doubles, f"{norm}.running_var", size, where=where) < 0.0).any():
            raise PemError(f"{where}: tensor '{norm}.running_var' holds negative variances")
        layers.append(
            fold_batch_norm(
                layer,
                scale=_vector(doubles, f"{norm}.weight", size, where=where),
                shift=_vector(doubles, f"{norm}.bias", size, where=where),
                mean=_vector(doubles, f"{norm}.running_mean", size, where=where),
                variance=_vector(doubles, f"{norm}.running_var", size, where=where),
            )
        )
    layers.append(_layer(doubles, _OUTPUT, where=where))
    columns = len(SALIENT_COLUMNS)
    pose = list(POSE_INDEX)
    card = PemCard(
        name=name,
        model="ml-nn",
        data=f"as stated by the checkpoint: {source}" if source else "not stated by the checkpoint",
        licence=UNKNOWN_LICENCE,
        recipe="not stated by the checkpoint (the authors' format)",
    )
    return NetworkPem(
        card=card,
        pose_mean=_vector(doubles, "input_mean", columns, where=where)[pose],
        pose_std=_vector(doubles, "input_std", columns, where=where)[pose],
        layers=tuple(layers),
    )


def _tensor(tensors: Mapping[str, FloatArray], key: str, *, where: str) -> FloatArray:
    if key not in tensors:
        raise PemError(f"{where}: tensor {key!r} is missing from the checkpoint")
    return tensors[key]


def _vector(tensors: Mapping[str, FloatArray], key: str, size: int, *, where: str) -> FloatArray:
    vector = _tensor(tensors, key, where=where)
    if vector.shape != (size,):
        raise PemError(f"{where}: tensor {key!r} has shape {list(vector.shape)}, need [{size}]")
    return vector


def _layer(tensors: Mapping[str, FloatArray], key: str, *, where: str) -> Layer:
    weight = _tensor(tensors, f"{key}.weight", where=where)
    if weight.ndim != 2:
        raise PemError(
            f"{where}: tensor '{key}.weight' has shape {list(weight.shape)}, need 2 axes"
        )
    return Layer(weight=weight, bias=_vector(tensors, f"{key}.bias", len(weight), where=where))
