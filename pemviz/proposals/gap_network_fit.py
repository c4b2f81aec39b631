"""Training of the paper's proposal network by weighted cross-entropy."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.proposals.gap_network import HIDDEN_UNITS, GapNetwork
from pemviz.proposals.gap_network_gradient import GapLoss, Parameters
from pemviz.proposals.outcome_sums import OutcomeSums

EPOCHS_BETWEEN_PAUSES = 50
FORGETTING = (0.9, 0.999)
"""Adam's rates of its two moments."""
LEAST_SIZE = 1e-8
"""What Adam adds to a gradient's size before it divides by it."""


@dataclass(frozen=True)
class OutcomeTable:
    """Weighted outcomes, pooled over equal gaps.

    The loss is a sum over outcomes that depend on the gap alone, so equal gaps can be
    pooled without changing it; rollouts share most of theirs.

    Attributes:
        gap_m: Distinct gaps ``[U]``.
        detected_weight: Weight of 'detected' at each, ``[U]``.
        missed_weight: Weight of 'missed' at each, ``[U]``; the two sum to 1 over all gaps.
    """

    gap_m: FloatArray
    detected_weight: FloatArray
    missed_weight: FloatArray


def table_of(sums: OutcomeSums) -> OutcomeTable:
    """Sums over rollouts with weights that sum to 1, as a network is trained on them."""
    return OutcomeTable(gap_m=sums.gap_m, detected_weight=sums.detected, missed_weight=sums.missed)


def initial_gap_network(*, seed: int) -> GapNetwork:
    """An untrained network with torch's default initialisation, for a 63-bit ``seed``.

    To the last bit what ``torch.manual_seed(seed)`` and three ``torch.nn.Linear`` give on the CPU:
    weights and biases uniform within +-1 / sqrt(inputs), in single precision, from a Mersenne
    Twister that is seeded with the seed's low 32 bits.
    """
    source = np.random.RandomState(seed & 0xFFFFFFFF)
    weights: list[FloatArray] = []
    biases: list[FloatArray] = []
    for outputs, inputs in ((HIDDEN_UNITS, 1), (HIDDEN_UNITS, HIDDEN_UNITS), (2, HIDDEN_UNITS)):
        reach = 1.0 / math.sqrt(inputs)
        weights.append(_single_uniform(source, (outputs, inputs), reach=reach))
        biases.append(_single_uniform(source, (outputs,), reach=reach))
    return GapNetwork(
        weights=(weights[0], weights[1], weights[2]), biases=(biases[0], biases[1], biases[2])
    )


def _single_uniform(
    source: np.random.RandomState, shape: tuple[int, ...], *, reach: float
) -> FloatArray:
    """Uniform within +-``reach``, rounded to single precision once, of 24 random bits each."""
    bits = np.frombuffer(source.bytes(4 * math.prod(shape)), dtype="<u4") & 0xFFFFFF
    low, high = np.float32(-reach), np.float32(reach)
    spread = np.float64(high - low)
    drawn = bits * 2.0**-24 * spread + np.float64(low)
    return drawn.astype(np.float32).astype(np.float64).reshape(shape)


def fit_gap_network(
    start: GapNetwork,
    table: OutcomeTable,
    *,
    epochs: int,
    learning_rate: float,
    pause: Callable[[], None] | None = None,
) -> tuple[GapNetwork, float]:
    """Minimise the weighted cross-entropy by full-batch Adam, fresh moments, from ``start``.

    Args:
        start: Where training begins; it is not changed.
        table: The outcomes.
        epochs: Training steps.
        learning_rate: Adam's step size.
        pause: Called every so many epochs; may raise to stop.

    Returns:
        The trained network and its loss [nats a step].

    The loss is the cross-entropy of the paper's Algorithm 1, line 9, with weights to sum 1. Its
    gradient is that of :mod:`pemviz.proposals.gap_network_gradient`, in double precision.
    """
    at, gradient = _parameters(start), Parameters()
    loss = GapLoss(
        table.gap_m / start.gap_scale_m,
        detected_weight=table.detected_weight,
        missed_weight=table.missed_weight,
    )
    adam = Adam(at.flat.size, step_size=_step_sizes(learning_rate).flat)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for epoch in range(epochs):
            if pause is not None and epoch % EPOCHS_BETWEEN_PAUSES == 0:
                pause()
            loss.gradient(at, into=gradient)
            at.flat -= adam.step(gradient.flat)
        final = loss.value(at)
    return _network(start, at), final


class Adam:
    """Adam (Kingma & Ba 2015, Algorithm 1) with its usual constants, from fresh moments."""

    def __init__(self, size: int, *, step_size: FloatArray) -> None:
        """Start with moments 0.

        Args:
            size: How many parameters P.
            step_size: Of each ``[P]``.
        """
        self._first, self._second = np.zeros(size), np.zeros(size)
        self._step_size = step_size
        self._steps = 0

    def step(self, gradient: FloatArray) -> FloatArray:
        """What to take from the parameters ``[P]`` after a gradient ``[P]``."""
        self._steps += 1
        self._first *= FORGETTING[0]
        self._first += (1.0 - FORGETTING[0]) * gradient
        self._second *= FORGETTING[1]
        self._second += (1.0 - FORGETTING[1]) * np.square(gradient)
        bias, bias_of_square = (1.0 - rate**self._steps for rate in FORGETTING)
        size = np.sqrt(self._second)
        size /= math.sqrt(bias_of_square)
        size += LEAST_SIZE
        np.divide(self._first, size, out=size)
        size *= self._step_size
        size /= bias
        return size


def _parameters(network: GapNetwork) -> Parameters:
    """The network's numbers, of its last layer the difference of 'detected' and 'missed'."""
    at = Parameters()
    at.layer_1[0], at.layer_1[1] = network.weights[0][:, 0], network.biases[0]
    at.weight_2[:], at.bias_2[:] = network.weights[1], network.biases[1]
    at.weight_3[:] = network.weights[2][1] - network.weights[2][0]
    at.bias_3[:] = network.biases[2][1] - network.biases[2][0]
    return at


def _step_sizes(learning_rate: float) -> Parameters:
    """Of every parameter: the last layer's two outputs have opposite gradients, and part twice."""
    sizes = Parameters()
    sizes.flat[:] = learning_rate
    sizes.weight_3 *= 2.0
    sizes.bias_3 *= 2.0
    return sizes


def _network(start: GapNetwork, at: Parameters) -> GapNetwork:
    """The network that ``start`` has become: its last layer's outputs have moved in opposition."""
    before, signs = _parameters(start), np.array([-0.5, 0.5])
    moved = at.weight_3 - before.weight_3, at.bias_3 - before.bias_3
    return GapNetwork(
        weights=(
            at.layer_1[0][:, None].copy(),
            at.weight_2.copy(),
            start.weights[2] + signs[:, None] * moved[0],
        ),
        biases=(at.layer_1[1].copy(), at.bias_2.copy(), start.biases[2] + signs * moved[1]),
        gap_scale_m=start.gap_scale_m,
    )
