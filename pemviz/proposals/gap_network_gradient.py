"""Loss and closed gradient of the paper's proposal network, exactly, piece by piece of its input.

The network has one input. Each unit of its first layer changes sign at one place of it, so that
those of the second are linear in the input between two such places; so is the answer between
places where a unit of either layer changes sign. With l = a x + c the logit of 'detected',

    loss = sum over u of d_u log(1 + exp(-l_u)) + m_u log(1 + exp(l_u))
    dl_u = (d_u + m_u) / (1 + exp(-l_u)) - d_u

depend on the outcomes at all places u (weights d detected, m missed), every gradient on the pieces'
sums of dl and of dl x alone. Pieces are a dozen where places are thousands.
"""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.proposals.gap_network import HIDDEN_UNITS

UNITS = HIDDEN_UNITS


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
        sizes = (2 * UNITS, UNITS * UNITS, UNITS, UNITS, 1)
        self.flat = np.zeros(sum(sizes))
        first, square, self.bias_2, self.weight_3, self.bias_3 = np.split(
            self.flat, np.cumsum(sizes)[:-1]
        )
        self.layer_1 = first.reshape(2, UNITS)
        self.weight_2 = square.reshape(UNITS, UNITS)


@dataclass(frozen=True, eq=False)
class Pieces:
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
        """Keep the outcomes.

        Args:
            inputs: The network's, ascending ``[U]``.
            detected_weight: Of 'detected' at each ``[U]``.
            missed_weight: Of 'missed' at each ``[U]``.
        """
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

    def _logits(self, at: Parameters, pieces: Pieces) -> FloatArray:
        counts = pieces.starts[1:] - pieces.starts[:-1]
        logit = (pieces.slope @ at.weight_3).repeat(counts)
        logit *= self._inputs
        logit += (pieces.offset @ at.weight_3 + at.bias_3).repeat(counts)
        return logit

    def _pieces(self, at: Parameters) -> Pieces:
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
        return Pieces(finer, on_1, on_2, slope, offset)

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
        piece = at // UNITS
        cuts = self._inputs.searchsorted(negative.take(at) / slope.take(at))
        np.maximum(cuts, starts[piece], out=cuts)
        np.minimum(cuts, starts[piece + 1], out=cuts)
        finer = np.concatenate((starts, cuts))
        finer.sort()
        return finer
