"""Feed-forward networks on the paper's 14 inputs, evaluated in double precision by numpy.

The inputs are seven classes one-hot, three occlusion levels one-hot, and x, y, z and rotation_y,
each less its training mean and divided by its training standard deviation. Logistic regression is a
network without hidden layers, guessing the mean one whose weights are 0. The published network of
the paper's authors is a torch state dict in safetensors: keys ``ff_nn.{0,1,3,4,6}.*`` of Linear,
BatchNorm, ReLU, Linear, BatchNorm, ReLU, Linear, and ``input_mean`` and ``input_std`` of the eleven
raw columns.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, FloatArray
from pemviz.chunks import map_rows
from pemviz.errors import PemError
from pemviz.pem.models.cards import UNKNOWN_LICENCE, Carded, PemCard
from pemviz.pem.models.own_features import OwnFeatures
from pemviz.pem.models.protocol import (
    CLASS_NAMES,
    COLUMN,
    OCCLUSION_NAMES,
    SALIENT_COLUMNS,
    as_double,
    as_rows,
    check_finite,
    check_rows,
    tensors_digest,
)

POSE_COLUMNS = ("x_m", "y_m", "z_m", "rotation_y_rad")
PAPER_INPUTS = (
    *(f"class={name}" for name in CLASS_NAMES),
    *(f"occlusion={name}" for name in OCCLUSION_NAMES),
    *POSE_COLUMNS,
)
POSE_INDEX = tuple(COLUMN[name] for name in POSE_COLUMNS)
MULTIPLE = 8
"""Rows are answered in multiples of so many, so that none is rounded otherwise for being last."""
FARTHEST = 1e6
"""Far beyond any x, y, z [m] or angle [rad] that a scenario holds."""
BATCH_NORM_EPSILON = 1e-5
"""torch's default, which the authors' checkpoint does not carry."""

_POSE = slice(POSE_INDEX[0], POSE_INDEX[-1] + 1)
_FIRST_POSE = len(CLASS_NAMES) + len(OCCLUSION_NAMES)
LEAST_SPREAD = 1e-9
"""Of a column [m, rad], or of its mean: below it a column does not vary."""


def paper_inputs(
    rows: FloatArray, *, pose_mean: FloatArray, pose_std: FloatArray, multiple: int = 1
) -> FloatArray:
    """The paper's inputs [14, n] of salient variables [n, 11]; features come first.

    Args:
        rows: salient variables, shape [n, 11].
        pose_mean: means of x, y, z [m] and rotation_y [rad] over the training data, shape [4].
        pose_std: their standard deviations, shape [4].
        multiple: columns of zeros follow, to a multiple of so many.
    """
    columns, count = rows.T, len(rows)
    inputs = np.empty((len(PAPER_INPUTS), count + -count % multiple), dtype=rows.dtype)
    inputs[:, count:] = 0.0
    codes = np.arange(len(CLASS_NAMES), dtype=rows.dtype)[:, None]
    inputs[: len(CLASS_NAMES), :count] = columns[COLUMN["class_id"]] == codes
    inputs[len(CLASS_NAMES) : _FIRST_POSE, :count] = (
        columns[COLUMN["occlusion"]] == codes[: len(OCCLUSION_NAMES)]
    )
    inputs[_FIRST_POSE:, :count] = (columns[_POSE] - pose_mean[:, None]) / pose_std[:, None]
    return inputs


def pose_statistics(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and (sample) standard deviation of x, y, z and rotation_y over rows [n, 11].

    A column that does not vary gets standard deviation 1, so that it maps to 0: its own, by
    rounding, need not be 0, and divided by it any other value would be billions.
    """
    pose = rows[:, _POSE]
    mean = pose.mean(axis=0)
    std = pose.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(len(POSE_COLUMNS))
    varies = std > LEAST_SPREAD * np.maximum(np.abs(mean), 1.0)
    return mean, np.where(varies, std, 1.0)


def statistics_of(rows: FloatArray, own: OwnFeatures | None) -> tuple[FloatArray, FloatArray]:
    """Mean and deviation of what is normalised, of rows ``[n, D]``."""
    return pose_statistics(rows) if own is None else own.statistics(rows)


def inputs_of(
    rows: FloatArray,
    own: OwnFeatures | None,
    *,
    pose_mean: FloatArray,
    pose_std: FloatArray,
    multiple: int = 1,
) -> FloatArray:
    """Inputs ``[K, n]`` of rows ``[n, D]``: the paper's, or those of features of one's own."""
    if own is None:
        return paper_inputs(rows, pose_mean=pose_mean, pose_std=pose_std, multiple=multiple)
    return own.inputs(rows, mean=pose_mean, std=pose_std, multiple=multiple)


def input_names(own: OwnFeatures | None) -> tuple[str, ...]:
    """What a network sees, in order."""
    return PAPER_INPUTS if own is None else own.input_names


def sound_rows(salient: ArrayLike, own: OwnFeatures | None) -> tuple[FloatArray, tuple[int, ...]]:
    """Rows ``[n, D]`` of salient variables ``[..., D]``, and the leading shape.

    Raises:
        PemError: They are not such as the model was made for.
    """
    if own is not None:
        return own.as_rows(salient)
    rows, shape = as_rows(salient)
    check_rows(rows)
    return rows, shape


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


@dataclass(frozen=True, eq=False)
class NetworkPem(Carded):
    """A network with rectified hidden layers and one output, the logit of P(detected).

    Raises:
        PemError: a shape does not fit its neighbours, or a number is not finite.
    """

    kind: ClassVar[str] = "network"

    card: PemCard
    pose_mean: FloatArray
    """Training means of x, y, z [m] and rotation_y [rad], shape [4]."""
    pose_std: FloatArray
    """Their standard deviations, shape [4]."""
    layers: tuple[Layer, ...]
    """Hidden layers, then the output layer."""
    own: OwnFeatures | None = None
    """What it sees in place of a road user's salient variables; the numbers among them are what is
    normalised."""

    def __post_init__(self) -> None:
        check_finite(self.tensors(), where=self.card.name)
        pose = (len(POSE_COLUMNS) if self.own is None else len(self.own.numeric),)
        if self.pose_mean.shape != pose or self.pose_std.shape != pose:
            raise PemError(f"{self.card.name}: pose mean and deviation need shape {list(pose)}")
        if not (self.pose_std > 0.0).all():
            raise PemError(f"{self.card.name}: pose standard deviations must be above 0")
        names = input_names(self.own)
        _check_layers(self.layers, inputs=len(names), where=self.card.name)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            # a bound on |logit| for obstacles within FARTHEST of 0 in each pose variable
            reach = (FARTHEST + np.abs(self.pose_mean)) / self.pose_std
            reach = np.concatenate([np.ones(len(names) - len(reach)), reach])
            for layer in self.layers:
                reach = np.abs(layer.weight) @ reach + np.abs(layer.bias)
        if not np.isfinite(reach[0]):
            raise PemError(f"{self.card.name}: its numbers are so large that answers overflow")

    @property
    def digest(self) -> str:
        """SHA-256 of the tensors, and of features of one's own."""
        about = self.kind if self.own is None else f"{self.kind}:{self.own.to_json()}"
        return tensors_digest(about, self.tensors())

    def tensors(self) -> dict[str, AnyArray]:
        """Everything that decides the answers, by the names used in files."""
        named: dict[str, AnyArray] = {"pose.mean": self.pose_mean, "pose.std": self.pose_std}
        for index, layer in enumerate(self.layers):
            named[f"layers.{index}.weight"] = layer.weight
            named[f"layers.{index}.bias"] = layer.bias
        return named

    def options(self) -> dict[str, Any]:
        """What a file must say beside the tensors: the inputs in order."""
        named = {"inputs": list(input_names(self.own))}
        return named if self.own is None else {**named, "features": self.own.to_json()}

    def logit(self, salient: ArrayLike) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables [..., 11], or of its own."""
        rows, shape = sound_rows(salient, self.own)
        return map_rows(self._answer, rows, padded=False).reshape(shape)

    def _answer(self, rows: FloatArray) -> FloatArray:
        pose = {"pose_mean": self.pose_mean, "pose_std": self.pose_std}
        return forward(self.layers, inputs_of(rows, self.own, **pose, multiple=MULTIPLE))[
            : len(rows)
        ]


def _check_layers(layers: Sequence[Layer], *, inputs: int, where: str) -> None:
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
    given, outputs = layers[0].weight.shape[1], layers[-1].weight.shape[0]
    if given != inputs or outputs != 1:
        raise PemError(
            f"{where}: the network maps {given} inputs to {outputs}, it must map {inputs} to 1"
        )


def fold_batch_norm(layer: Layer, norm: Mapping[str, FloatArray]) -> Layer:
    """The affine map that equals ``layer`` followed by batch normalisation in evaluation mode.

    Args:
        layer: the affine map before the normalisation, [outputs, inputs].
        norm: weight, bias, running_mean and running_var as torch names them, shapes [outputs].
    """
    # what overflows is not finite, and the model refuses that
    with np.errstate(over="ignore", invalid="ignore"):
        factor = norm["weight"] / np.sqrt(norm["running_var"] + BATCH_NORM_EPSILON)
        weight = layer.weight * factor[:, None]
        bias = (layer.bias - norm["running_mean"]) * factor + norm["bias"]
    return Layer(weight=weight, bias=bias)


def is_authors_checkpoint(tensors: Mapping[str, AnyArray]) -> bool:
    """Whether the tensors carry the authors' key names."""
    return any(name.startswith("ff_nn.") for name in tensors)


def authors_pem(
    tensors: Mapping[str, AnyArray], *, name: str, where: str, source: str | None = None
) -> NetworkPem:
    """Build the authors' model, batch normalisations folded, in double precision.

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

    def tensor(key: str) -> FloatArray:
        if key not in doubles:
            raise PemError(f"{where}: tensor {key!r} is missing from the checkpoint")
        return doubles[key]

    def vector(key: str, size: int) -> FloatArray:
        shape = list(tensor(key).shape)
        if shape != [size]:
            raise PemError(f"{where}: tensor {key!r} has shape {shape}, need [{size}]")
        return doubles[key]

    def affine(key: str) -> Layer:
        weight = tensor(f"{key}.weight")
        if weight.ndim != 2:
            shape = list(weight.shape)
            raise PemError(f"{where}: tensor '{key}.weight' has shape {shape}, need 2 axes")
        return Layer(weight=weight, bias=vector(f"{key}.bias", len(weight)))

    layers: list[Layer] = []
    for linear, norm in (("ff_nn.0", "ff_nn.1"), ("ff_nn.3", "ff_nn.4")):
        layer = affine(linear)
        parts = ("running_var", "weight", "bias", "running_mean")
        state = {part: vector(f"{norm}.{part}", len(layer.bias)) for part in parts}
        if (state["running_var"] < 0.0).any():
            raise PemError(f"{where}: tensor '{norm}.running_var' holds negative variances")
        layers.append(fold_batch_norm(layer, state))
    layers.append(affine("ff_nn.6"))
    card = PemCard(
        name=name,
        model="ml-nn",
        data=f"as stated by the checkpoint: {source}" if source else "not stated by the checkpoint",
        licence=UNKNOWN_LICENCE,
        recipe="not stated by the checkpoint (the authors' format)",
    )
    return NetworkPem(
        card=card,
        pose_mean=vector("input_mean", len(SALIENT_COLUMNS))[_POSE],
        pose_std=vector("input_std", len(SALIENT_COLUMNS))[_POSE],
        layers=tuple(layers),
    )
