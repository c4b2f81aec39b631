"""The paper's proposal: a small network that sees nothing but the gap."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.chunks import map_rows
from pemviz.types import CERTAIN, StateBatch

GAP_SCALE_M = 12.0
HIDDEN_UNITS = 32
FARTHEST_M = 1e6


@dataclass(frozen=True)
class GapNetwork:
    """Two hidden layers of ReLU units and two log-softmax outputs, 'missed' and 'detected'.

    The layout is that of the networks published by the paper's authors.

    Attributes:
        weights: Three matrices, shapes ``[32, 1]``, ``[32, 32]``, ``[2, 32]``.
        biases: Three vectors, shapes ``[32]``, ``[32]``, ``[2]``.
        gap_scale_m: The input is the gap divided by this.
    """

    weights: tuple[FloatArray, FloatArray, FloatArray]
    biases: tuple[FloatArray, FloatArray, FloatArray]
    gap_scale_m: float = GAP_SCALE_M

    def logit_at(self, gap_m: FloatArray) -> FloatArray:
        """Logit of 'detected' at gaps of any shape ``[...]``."""
        rows = gap_m.reshape(-1)[:, None] / self.gap_scale_m
        return map_rows(self._forward, rows).reshape(gap_m.shape)

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]``, from the gap alone; the model's where that is certain."""
        logit = self.logit_at(states.signals["gap"])
        if CERTAIN in states.memory:
            return np.where(states.memory[CERTAIN], pem_logit, logit)
        return logit

    def arrays(self) -> Mapping[str, AnyArray]:
        """The six parameters, named as torch names those of a sequential network."""
        named: dict[str, AnyArray] = {}
        for layer, weight, bias in zip((0, 2, 4), self.weights, self.biases, strict=True):
            named[f"{layer}.weight"] = weight
            named[f"{layer}.bias"] = bias
        return named

    def _forward(self, rows: FloatArray) -> FloatArray:
        hidden = rows
        zero = np.zeros((), dtype=rows.dtype)
        for weight, bias in zip(self.weights[:2], self.biases[:2], strict=True):
            hidden = hidden @ weight.T
            hidden += bias
            np.maximum(hidden, zero, out=hidden)
        outputs = hidden @ self.weights[2].T + self.biases[2]
        return outputs[:, 1] - outputs[:, 0]


def gap_network_from_arrays(arrays: Mapping[str, AnyArray]) -> GapNetwork:
    """The inverse of :meth:`GapNetwork.arrays`.

    Raises:
        KeyError: A parameter is missing.
        ValueError: The parameters do not form such a network, or its answers overflow.
    """
    weights = [np.asarray(arrays[f"{layer}.weight"], dtype=np.float64) for layer in (0, 2, 4)]
    biases = [np.asarray(arrays[f"{layer}.bias"], dtype=np.float64) for layer in (0, 2, 4)]
    check_network(weights, biases)
    return GapNetwork(
        weights=(weights[0], weights[1], weights[2]), biases=(biases[0], biases[1], biases[2])
    )


def check_network(weights: Sequence[FloatArray], biases: Sequence[FloatArray]) -> None:
    """Check that layers fit together and answer with finite numbers at any gap up to 1e6 m.

    Raises:
        ValueError: They do not.
    """
    reach = np.full(1, FARTHEST_M / GAP_SCALE_M)
    for weight, bias in zip(weights, biases, strict=True):
        if weight.shape != (bias.size, reach.size) or bias.ndim != 1:
            message = f"a layer has weights {weight.shape} and biases {bias.shape}"
            raise ValueError(message)
        with np.errstate(over="ignore", invalid="ignore"):
            reach = np.abs(weight) @ reach + np.abs(bias)
    with np.errstate(over="ignore", invalid="ignore"):
        largest = reach.sum()  # the answer is the difference of the two
    if reach.shape != (2,) or not np.isfinite(largest):
        message = "the network must answer with two finite numbers"
        raise ValueError(message)
