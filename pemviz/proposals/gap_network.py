"""The paper's proposal, a small network that sees nothing but the gap, and its training.

Loss and gradient are exact, piece by piece of the one input. Each unit of the first layer changes
sign at one place of it, so that those of the second are linear in the input between two such
places; so is the answer between places where a unit of either layer changes sign. With l = a x + c
the logit of 'detected',

    loss = sum over u of d_u log(1 + exp(-l_u)) + m_u log(1 + exp(l_u))
    dl_u = (d_u + m_u) / (1 + exp(-l_u)) - d_u

depend on the outcomes at all places u (weights d detected, m missed), every gradient on the pieces'
sums of dl and of dl x alone. Pieces are a dozen where places are thousands.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.chunks import map_rows
from pemviz.types import CERTAIN, StateBatch

GAP_SCALE_M = 12.0
"""The input is the gap divided by this."""
HIDDEN_UNITS = 32
FARTHEST_M = 1e6
EPOCHS_BETWEEN_PAUSES = 50
FORGETTING = (0.9, 0.999)
"""Adam's rates of its two moments."""
LEAST_SIZE = 1e-8
"""What Adam adds to a gradient's size before it divides by it."""


@dataclass(frozen=True)
class GapNetwork:
    """Two hidden layers of ReLU units and two log-softmax outputs, 'missed' and 'detected'.

    The layout is that of the networks published by the paper's authors.

    Attributes:
        weights: Three matrices, shapes ``[32, 1]``, ``[32, 32]``, ``[2, 32]``.
        biases: Three vectors, shapes ``[32]``, ``[32]``, ``[2]``.
    """

    weights: tuple[FloatArray, FloatArray, FloatArray]
    biases: tuple[FloatArray, FloatArray, FloatArray]

    def logit_at(self, gap_m: FloatArray) -> FloatArray:
        """Logit of 'detected' at gaps of any shape ``[...]``."""
        rows = gap_m.reshape(-1)[:, None] / GAP_SCALE_M
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
    """The inverse of :meth:`GapNetwork.arrays`, of layers that fit together.

    Raises:
        KeyError: A parameter is missing.
        ValueError: The parameters do not form such a network, or its answers at gaps up to 1e6 m
            are not finite.
    """
    weights = [np.asarray(arrays[f"{layer}.weight"], dtype=np.float64) for layer in (0, 2, 4)]
    biases = [np.asarray(arrays[f"{layer}.bias"], dtype=np.float64) for layer in (0, 2, 4)]
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
    return GapNetwork(
        weights=(weights[0], weights[1], weights[2]), biases=(biases[0], biases[1], biases[2])
    )


class Parameters:
    """The network's numbers in one row, and its parts as views.

    Of the last layer the difference of its two outputs alone, on which loss and answer depend.

    Attributes:
        flat: All ``[P]``.
        layer_1: Weights and biases ``[2, 32]``.
        weight_2: ``[32, 32]``.
        bias_2: ``[32]``.
        weight_3: ``[32]``.
        bias_3: ``[1]``.
    """

    def __init__(self) -> None:
        sizes = (2 * HIDDEN_UNITS, HIDDEN_UNITS * HIDDEN_UNITS, HIDDEN_UNITS, HIDDEN_UNITS, 1)
        self.flat = np.zeros(sum(sizes))
        first, square, self.bias_2, self.weight_3, self.bias_3 = np.split(
            self.flat, np.cumsum(sizes)[:-1]
        )
        self.layer_1 = first.reshape(2, HIDDEN_UNITS)
        self.weight_2 = square.reshape(HIDDEN_UNITS, HIDDEN_UNITS)


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Stretches of the places between which units change sign, some perhaps empty.

    Attributes:
        starts: Index of the first place of each, and the number of places ``[K + 1]``.
        on_1: Which units of the first layer are above 0, ``[K, 32]`` of 0 and 1.
        on_2: Of the second ``[K, 32]``.
        slope: Of the second layer's outputs in the input, 0 of units that are off ``[K, 32]``.
        offset: Likewise ``[K, 32]``.
    """

    starts: IntArray
    on_1: FloatArray
    on_2: FloatArray
    slope: FloatArray
    offset: FloatArray


class GapLoss:
    """The weighted cross-entropy of outcomes at ascending places."""

    def __init__(
        self, inputs: FloatArray, *, detected_weight: FloatArray, missed_weight: FloatArray
    ) -> None:
        """Inputs of the network, ascending, and weights of both outcomes at each, ``[U]``."""
        self._inputs, self._detected = inputs, detected_weight
        self._both = detected_weight + missed_weight
        self._bounds = np.array([0]), np.array([inputs.size])
        self._sums = np.zeros((2, inputs.size + 1))

    def value(self, at: Parameters) -> float:
        """The loss."""
        logit = self._logits(at, self._pieces(at))
        return float(self._both @ np.logaddexp(0.0, logit) - self._detected @ logit)

    def gradient(self, at: Parameters, *, into: Parameters) -> None:
        """Write the loss's gradient ``into``.

        Numpy warns of a division by 0 at a unit whose input has no weight; it changes no sign.
        """
        pieces = self._pieces(at)
        change = self._logits(at, pieces)
        np.negative(change, out=change)
        np.exp(change, out=change)
        change += 1.0
        np.divide(self._both, change, out=change)
        change -= self._detected
        np.cumsum(change, out=self._sums[1, 1:])
        change *= self._inputs
        np.cumsum(change, out=self._sums[0, 1:])
        reached = self._sums[:, pieces.starts]
        sums = reached[:, 1:] - reached[:, :-1]
        on_answer = pieces.on_2 * at.weight_3
        back = on_answer @ at.weight_2
        back *= pieces.on_1
        np.matmul(sums, back, out=into.layer_1)
        first = sums.T @ at.layer_1
        first *= pieces.on_1
        np.matmul(on_answer.T, first, out=into.weight_2)
        np.matmul(sums[1], on_answer, out=into.bias_2)
        np.add(sums[0] @ pieces.slope, sums[1] @ pieces.offset, out=into.weight_3)
        into.bias_3[0] = self._sums[1, -1]

    def _logits(self, at: Parameters, pieces: _Pieces) -> FloatArray:
        counts = pieces.starts[1:] - pieces.starts[:-1]
        logit = (pieces.slope @ at.weight_3).repeat(counts)
        logit *= self._inputs
        logit += (pieces.offset @ at.weight_3 + at.bias_3).repeat(counts)
        return logit

    def _pieces(self, at: Parameters) -> _Pieces:
        weight_1, bias_1 = at.layer_1
        turns = self._inputs.searchsorted(bias_1 / -weight_1)
        starts = np.concatenate((self._bounds[0], turns, self._bounds[1]))
        starts.sort()
        low, high = starts.searchsorted((1, self._inputs.size))
        starts = starts[low - 1 : high + 1]
        first, last = self._ends(starts)
        on_1 = ((0.5 * (first + last)) * weight_1 > -bias_1).astype(np.float64)
        slope = (on_1 * weight_1) @ at.weight_2.T
        offset = (on_1 * bias_1) @ at.weight_2.T
        offset += at.bias_2
        finer = self._finer(starts, (first, last), slope, offset)
        coarse = starts.searchsorted(finer[:-1], side="right") - 1
        first, last = self._ends(finer)
        on_1, slope, offset = on_1[coarse], slope[coarse], offset[coarse]
        on_2 = ((0.5 * (first + last)) * slope > -offset).astype(np.float64)
        slope *= on_2
        offset *= on_2
        return _Pieces(finer, on_1, on_2, slope, offset)

    def _ends(self, starts: IntArray) -> tuple[FloatArray, FloatArray]:
        """First and last input of each piece ``[K, 1]``; of an empty one, anything."""
        first = self._inputs.take(starts[:-1], mode="clip")
        return first[:, None], self._inputs[starts[1:] - 1][:, None]

    def _finer(
        self,
        starts: IntArray,
        ends: tuple[FloatArray, FloatArray],
        slope: FloatArray,
        offset: FloatArray,
    ) -> IntArray:
        """The pieces, cut where a unit of the second layer changes sign."""
        negative = -offset
        changes = (ends[0] * slope > negative) != (ends[1] * slope > negative)
        (at,) = changes.ravel().nonzero()
        if not at.size:
            return starts
        piece = at // HIDDEN_UNITS
        cuts = self._inputs.searchsorted(negative.take(at) / slope.take(at))
        np.maximum(cuts, starts[piece], out=cuts)
        np.minimum(cuts, starts[piece + 1], out=cuts)
        finer = np.concatenate((starts, cuts))
        finer.sort()
        return finer


@dataclass(frozen=True)
class OutcomeTable:
    """Weighted outcomes summed over equal gaps, at first of none.

    The loss is a sum over outcomes that depend on the gap alone, so equal gaps can be summed
    without changing it; rollouts share most of theirs. Terms are added in the outcomes' order.

    Attributes:
        gap_m: Distinct gaps, ascending ``[U]``.
        detected_weight: Weight of 'detected' at each, ``[U]``.
        missed_weight: Weight of 'missed' at each, ``[U]``; the two sum to 1 over all gaps where
            the weights of all rollouts do.
    """

    gap_m: FloatArray = field(default_factory=lambda: np.empty(0))
    detected_weight: FloatArray = field(default_factory=lambda: np.empty(0))
    missed_weight: FloatArray = field(default_factory=lambda: np.empty(0))

    def with_rollouts(
        self, *, gap_m: FloatArray, detected: BoolArray, rollout_weight: FloatArray
    ) -> "OutcomeTable":
        """With outcomes ``[N, T-1]`` of rollouts with weights ``[N]``: the same as all at once."""
        steps = detected.shape[1]
        weight = np.repeat(rollout_weight / steps, steps)
        some, index = np.unique(gap_m.ravel(), return_inverse=True)
        distinct = np.union1d(self.gap_m, some)
        before = np.searchsorted(distinct, self.gap_m)
        at = np.concatenate([before, np.searchsorted(distinct, some)[index]])

        def summed(so_far: FloatArray, more: FloatArray) -> FloatArray:
            # sums go on where they were: the first weights are those sums
            both = np.concatenate([so_far, more])
            return np.bincount(at, weights=both, minlength=distinct.size).astype(np.float64)

        hit = detected.ravel()
        return OutcomeTable(
            gap_m=distinct,
            detected_weight=summed(self.detected_weight, weight * hit),
            missed_weight=summed(self.missed_weight, weight * ~hit),
        )


def initial_gap_network(*, seed: int) -> GapNetwork:
    """An untrained network with torch's default initialisation, for a 63-bit ``seed``.

    To the last bit what ``torch.manual_seed(seed)`` and three ``torch.nn.Linear`` give on the CPU:
    weights and biases uniform within +-1 / sqrt(inputs), in single precision, from a Mersenne
    Twister that is seeded with the seed's low 32 bits.
    """
    source = np.random.RandomState(seed & 0xFFFFFFFF)
    weights: list[FloatArray] = []
    biases: list[FloatArray] = []

    def uniform(shape: tuple[int, ...], *, reach: float) -> FloatArray:
        # of 24 random bits each, rounded to single precision once
        bits = np.frombuffer(source.bytes(4 * math.prod(shape)), dtype="<u4") & 0xFFFFFF
        low, high = np.float32(-reach), np.float32(reach)
        spread = np.float64(high - low)
        sampled = bits * 2.0**-24 * spread + np.float64(low)
        return sampled.astype(np.float32).astype(np.float64).reshape(shape)

    for outputs, inputs in ((HIDDEN_UNITS, 1), (HIDDEN_UNITS, HIDDEN_UNITS), (2, HIDDEN_UNITS)):
        reach = 1.0 / math.sqrt(inputs)
        weights.append(uniform((outputs, inputs), reach=reach))
        biases.append(uniform((outputs,), reach=reach))
    return GapNetwork(
        weights=(weights[0], weights[1], weights[2]), biases=(biases[0], biases[1], biases[2])
    )


def fit_gap_network(
    start: GapNetwork,
    table: OutcomeTable,
    *,
    epochs: int,
    learning_rate: float,
    pause: Callable[[], None] | None = None,
) -> tuple[GapNetwork, float]:
    """Minimise the weighted cross-entropy by full-batch Adam, fresh moments, from ``start``.

    The loss is the cross-entropy of the paper's Algorithm 1, line 9, with weights to sum 1, in
    double precision.

    Args:
        start: Where training begins; it is not changed.
        table: The outcomes.
        epochs: Training steps.
        learning_rate: Adam's step size.
        pause: Called every so many epochs; may raise to stop.

    Returns:
        The trained network and its loss [nats a step].
    """
    at, gradient, step_size = _parameters(start), Parameters(), Parameters()
    loss = GapLoss(
        table.gap_m / GAP_SCALE_M,
        detected_weight=table.detected_weight,
        missed_weight=table.missed_weight,
    )
    # the last layer's two outputs have opposite gradients, and part twice
    step_size.flat[:] = learning_rate
    step_size.weight_3 *= 2.0
    step_size.bias_3 *= 2.0
    adam = _Adam(step_size.flat)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for epoch in range(epochs):
            if pause is not None and epoch % EPOCHS_BETWEEN_PAUSES == 0:
                pause()
            loss.gradient(at, into=gradient)
            at.flat -= adam.step(gradient.flat)
        final = loss.value(at)
    before, signs = _parameters(start), np.array([-0.5, 0.5])
    moved = at.weight_3 - before.weight_3, at.bias_3 - before.bias_3
    trained = GapNetwork(
        weights=(
            at.layer_1[0][:, None].copy(),
            at.weight_2.copy(),
            start.weights[2] + signs[:, None] * moved[0],
        ),
        biases=(at.layer_1[1].copy(), at.bias_2.copy(), start.biases[2] + signs * moved[1]),
    )
    return trained, final


def _parameters(network: GapNetwork) -> Parameters:
    """The network's numbers, of its last layer the difference of 'detected' and 'missed'."""
    at = Parameters()
    at.layer_1[0], at.layer_1[1] = network.weights[0][:, 0], network.biases[0]
    at.weight_2[:], at.bias_2[:] = network.weights[1], network.biases[1]
    at.weight_3[:] = network.weights[2][1] - network.weights[2][0]
    at.bias_3[:] = network.biases[2][1] - network.biases[2][0]
    return at


class _Adam:
    """Adam (Kingma & Ba 2015, Algorithm 1) with its usual constants, from fresh moments."""

    def __init__(self, step_size: FloatArray) -> None:
        """Moments 0; the step size is that of each of the parameters ``[P]``."""
        self._first, self._second = np.zeros(step_size.size), np.zeros(step_size.size)
        self._step_size, self._steps = step_size, 0

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
