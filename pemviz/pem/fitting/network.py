"""The paper's ML-NN: Linear(14,20) BatchNorm ReLU Linear(20,20) BatchNorm ReLU Linear(20,1).

The paper names layers and loss (binary cross-entropy) but neither optimiser, batch nor epochs;
the defaults here were chosen once, to land on its Table I under cross-validation.
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from pemviz.arrays import FloatArray
from pemviz.pem.data.table import SalientTable
from pemviz.pem.models.authors_network import fold_batch_norm
from pemviz.pem.models.card import PemCard
from pemviz.pem.models.encoding import PAPER_INPUTS, paper_inputs, pose_statistics
from pemviz.pem.models.network import Layer, NetworkPem

HIDDEN_UNITS = 20


@dataclass(frozen=True)
class NetworkRecipe:
    """How the network is trained."""

    epochs: int = 200
    """Passes over the training data."""
    batch_rows: int = 1024
    """Obstacles per gradient step; the remainder of an epoch is left out."""
    learning_rate: float = 1e-3
    """Adam's step size."""

    def in_words(self) -> str:
        """For the model card."""
        return (
            f"Linear(14,{HIDDEN_UNITS}) BatchNorm ReLU Linear({HIDDEN_UNITS},{HIDDEN_UNITS}) "
            f"BatchNorm ReLU Linear({HIDDEN_UNITS},1), binary cross-entropy, Adam "
            f"{self.learning_rate:g}, batches of {self.batch_rows} reshuffled each epoch, "
            f"{self.epochs} epochs, no weight decay, batch normalisations folded afterwards"
        )


def fit_network(
    table: SalientTable,
    *,
    card: PemCard,
    seed: int,
    recipe: NetworkRecipe = NetworkRecipe(),
    on_progress: Callable[[int, int], None] | None = None,
) -> NetworkPem:
    """Train the paper's network; the same table, seed and recipe give the same numbers.

    Args:
        table: the training part; normalisation is fitted on it alone.
        card: the model's provenance.
        seed: of the initial weights and the order of batches.
        recipe: optimiser, batch, epochs.
        on_progress: told (epochs done, epochs in all).
    """
    pose_mean, pose_std = pose_statistics(table.salient)
    inputs = paper_inputs(table.salient, pose_mean=pose_mean, pose_std=pose_std).T
    with single_thread(seed):
        network = _network()
        _train(
            network,
            inputs=torch.tensor(np.ascontiguousarray(inputs), dtype=torch.float32),
            outcomes=torch.tensor(table.detected, dtype=torch.float32)[:, None],
            recipe=recipe,
            on_progress=on_progress,
        )
    return NetworkPem(card, pose_mean, pose_std, _folded(network))


@contextmanager
def single_thread(seed: int) -> Generator[None]:
    """Seed torch and keep it to one thread, then restore both.

    These networks are too small to gain from threads, and the order of sums over threads would
    make the result depend on the machine's cores.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(threads)


def _network() -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(len(PAPER_INPUTS), HIDDEN_UNITS),
        nn.BatchNorm1d(HIDDEN_UNITS),
        nn.ReLU(),
        nn.Linear(HIDDEN_UNITS, HIDDEN_UNITS),
        nn.BatchNorm1d(HIDDEN_UNITS),
        nn.ReLU(),
        nn.Linear(HIDDEN_UNITS, 1),
    )


def _train(
    network: nn.Sequential,
    *,
    inputs: torch.Tensor,
    outcomes: torch.Tensor,
    recipe: NetworkRecipe,
    on_progress: Callable[[int, int], None] | None,
) -> None:
    optimiser = torch.optim.Adam(network.parameters(), lr=recipe.learning_rate, fused=True)
    rows = len(inputs)
    batch = min(recipe.batch_rows, rows)
    for epoch in range(recipe.epochs):
        order = torch.randperm(rows)
        shuffled_inputs, shuffled_outcomes = inputs[order], outcomes[order]
        for start in range(0, rows - batch + 1, batch):
            predicted = network(shuffled_inputs[start : start + batch])
            loss = nn.functional.binary_cross_entropy_with_logits(
                predicted, shuffled_outcomes[start : start + batch]
            )
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        if on_progress is not None:
            on_progress(epoch + 1, recipe.epochs)


def _folded(network: nn.Sequential) -> tuple[Layer, ...]:
    layers: list[Layer] = []
    for linear, norm in ((0, 1), (3, 4)):
        state = {key: _double(value) for key, value in network[norm].state_dict().items()}
        layers.append(
            fold_batch_norm(
                _affine(network[linear]),
                scale=state["weight"],
                shift=state["bias"],
                mean=state["running_mean"],
                variance=state["running_var"],
            )
        )
    return (*layers, _affine(network[6]))


def _affine(module: nn.Module) -> Layer:
    state = module.state_dict()
    return Layer(weight=_double(state["weight"]), bias=_double(state["bias"]))


def _double(tensor: torch.Tensor) -> FloatArray:
    return tensor.detach().numpy().astype(np.float64)
