"""Training of the paper's proposal network by weighted cross-entropy."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.proposals.gap_network import GAP_SCALE_M, HIDDEN_UNITS, GapNetwork

EPOCHS_BETWEEN_PAUSES = 50


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


def pool_outcomes(
    *, gap_m: FloatArray, detected: BoolArray, rollout_weight: FloatArray
) -> OutcomeTable:
    """Pool outcomes ``[N, T-1]`` of rollouts with weights ``[N]`` that sum to 1."""
    steps = detected.shape[1]
    weight = np.repeat(rollout_weight / steps, steps)
    distinct, index = np.unique(gap_m.ravel(), return_inverse=True)
    hit = detected.ravel()
    return OutcomeTable(
        gap_m=distinct,
        detected_weight=_sum_by(index, weight * hit, distinct.size),
        missed_weight=_sum_by(index, weight * ~hit, distinct.size),
    )


def _sum_by(index: AnyArray, weight: FloatArray, size: int) -> FloatArray:
    return np.asarray(np.bincount(index, weights=weight, minlength=size), dtype=np.float64)


def initial_gap_network(*, seed: int) -> GapNetwork:
    """An untrained network with torch's default initialisation, for a 63-bit ``seed``."""
    import torch  # noqa: PLC0415  torch takes a second to import

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = _layers()
    return _frozen(layers)


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

    The loss is the cross-entropy of the paper's Algorithm 1, line 9, with weights to sum 1.
    """
    import torch  # noqa: PLC0415  torch takes a second to import

    single = torch.float32  # the published networks' precision, and twice as fast
    layers = _layers()
    layers.load_state_dict({n: torch.tensor(a, dtype=single) for n, a in start.arrays().items()})
    inputs = torch.tensor(table.gap_m[:, None] / start.gap_scale_m, dtype=single)
    target = torch.tensor(
        np.stack([table.missed_weight, table.detected_weight], axis=1), dtype=single
    )
    optimiser = torch.optim.Adam(layers.parameters(), lr=learning_rate, fused=True)
    with one_thread():
        for epoch in range(epochs):
            if pause is not None and epoch % EPOCHS_BETWEEN_PAUSES == 0:
                pause()
            optimiser.zero_grad(set_to_none=True)
            loss = -(target * torch.log_softmax(layers(inputs), dim=1)).sum()
            loss.backward()
            optimiser.step()
        with torch.no_grad():
            final = -(target * torch.log_softmax(layers(inputs), dim=1)).sum()
    return _frozen(layers), float(final)


def _layers() -> Any:
    import torch  # noqa: PLC0415

    return torch.nn.Sequential(
        torch.nn.Linear(1, HIDDEN_UNITS),
        torch.nn.ReLU(),
        torch.nn.Linear(HIDDEN_UNITS, HIDDEN_UNITS),
        torch.nn.ReLU(),
        torch.nn.Linear(HIDDEN_UNITS, 2),
    )


def _frozen(layers: Any) -> GapNetwork:
    state = {name: tensor.double().numpy() for name, tensor in layers.state_dict().items()}
    return GapNetwork(
        weights=(state["0.weight"], state["2.weight"], state["4.weight"]),
        biases=(state["0.bias"], state["2.bias"], state["4.bias"]),
        gap_scale_m=GAP_SCALE_M,
    )


class one_thread:  # noqa: N801  reads as a statement
    """Small layers on the CPU: a second thread of torch's costs more than it brings."""

    def __enter__(self) -> None:
        import torch  # noqa: PLC0415

        self._threads = torch.get_num_threads()
        torch.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        import torch  # noqa: PLC0415

        torch.set_num_threads(self._threads)
