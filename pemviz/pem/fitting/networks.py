"""The paper's networks: ML-NN and B-NN.

ML-NN is Linear(14,20) BatchNorm ReLU Linear(20,20) BatchNorm ReLU Linear(20,1). The paper names
layers and loss (binary cross-entropy) but neither optimiser, batch nor epochs; the defaults here
were chosen once, to land on its Table I under cross-validation.

B-NN has its layers without batch normalisation, with random weights: mean-field Gaussian
variational inference with standard normal priors, by the optional package pyro-ppl. What is kept is
a set of samples of the posterior, an ensemble whose mean probability is the model's answer; running
it needs no pyro.
"""

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import nn

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.pem.data.table import SalientTable
from pemviz.pem.models.cards import PemCard
from pemviz.pem.models.ensemble import EnsemblePem
from pemviz.pem.models.network import (
    Layer,
    NetworkPem,
    fold_batch_norm,
    inputs_of,
    statistics_of,
)

Progress = Callable[[int, int], None]
HIDDEN_UNITS = 20

EPOCHS = 200
BATCH_ROWS = 1024
"""Obstacles per gradient step; the remainder of an epoch is left out."""
LEARNING_RATE = 1e-3
RECIPE = (
    f"Linear(14,{HIDDEN_UNITS}) BatchNorm ReLU Linear({HIDDEN_UNITS},{HIDDEN_UNITS}) "
    f"BatchNorm ReLU Linear({HIDDEN_UNITS},1), binary cross-entropy, Adam "
    f"{LEARNING_RATE:g}, batches of {BATCH_ROWS} reshuffled each epoch, "
    f"{EPOCHS} epochs, no weight decay, batch normalisations folded afterwards"
)

BAYES_STEPS = 1500
BAYES_BATCH_ROWS = 1024
BAYES_LEARNING_RATE = 1e-2
INITIAL_SCALE = 0.05
DRAWS = 30

BAYES_RECIPE = (
    f"Linear(14,{HIDDEN_UNITS}) ReLU Linear({HIDDEN_UNITS},{HIDDEN_UNITS}) ReLU "
    f"Linear({HIDDEN_UNITS},1), standard normal priors, mean-field normal posterior by pyro "
    f"(AutoNormal, initial scale {INITIAL_SCALE:g}, TraceMeanField_ELBO), Adam "
    f"{BAYES_LEARNING_RATE:g}, {BAYES_STEPS} steps on batches of {BAYES_BATCH_ROWS}, {DRAWS} "
    "posterior draws kept"
)

_BAYES_LAYERS = 3


def fit_network(
    table: SalientTable, *, card: PemCard, seed: int, on_progress: Progress | None = None
) -> NetworkPem:
    """Train the ML-NN; the same table and seed give the same numbers.

    Normalisation is fitted on the table alone; ``on_progress`` is called with epochs done and in
    all.
    """
    pose_mean, pose_std = statistics_of(table.salient, table.features)
    inputs, outcomes = _as_tensors(table, pose_mean, pose_std)
    with single_thread(seed):
        network = nn.Sequential(
            nn.Linear(len(inputs.T), HIDDEN_UNITS),
            nn.BatchNorm1d(HIDDEN_UNITS),
            nn.ReLU(),
            nn.Linear(HIDDEN_UNITS, HIDDEN_UNITS),
            nn.BatchNorm1d(HIDDEN_UNITS),
            nn.ReLU(),
            nn.Linear(HIDDEN_UNITS, 1),
        )
        _train(network, inputs, outcomes[:, None], on_progress=on_progress)
    states = {
        index: {name: _double(value) for name, value in network[index].state_dict().items()}
        for index in (0, 1, 3, 4, 6)
    }
    affine = {index: Layer(states[index]["weight"], states[index]["bias"]) for index in (0, 3, 6)}
    hidden = (fold_batch_norm(affine[index], states[index + 1]) for index in (0, 3))
    return NetworkPem(card, pose_mean, pose_std, (*hidden, affine[6]), table.features)


def _as_tensors(
    table: SalientTable, pose_mean: FloatArray, pose_std: FloatArray
) -> tuple[torch.Tensor, torch.Tensor]:
    inputs = inputs_of(table.salient, table.features, pose_mean=pose_mean, pose_std=pose_std).T
    return (
        torch.tensor(np.ascontiguousarray(inputs), dtype=torch.float32),
        torch.tensor(table.detected, dtype=torch.float32),
    )


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


def _train(
    network: nn.Sequential,
    inputs: torch.Tensor,
    outcomes: torch.Tensor,
    *,
    on_progress: Progress | None,
) -> None:
    optimiser = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE, fused=True)
    rows = len(inputs)
    batch = min(BATCH_ROWS, rows)
    for epoch in range(EPOCHS):
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
            on_progress(epoch + 1, EPOCHS)


def _double(tensor: torch.Tensor) -> FloatArray:
    return tensor.detach().numpy().astype(np.float64)


def fit_bayes(
    table: SalientTable, *, card: PemCard, seed: int, on_progress: Progress | None = None
) -> EnsemblePem:
    """Fit the B-NN's posterior and sample members from it.

    Normalisation is fitted on the table alone; ``on_progress`` is called with steps done and in
    all.

    Raises:
        PemError: pyro-ppl is not installed.
    """
    try:
        for module in ("pyro.distributions", "pyro.infer.autoguide", "pyro.optim"):
            import_module(module)
        pyro: Any = import_module("pyro")
    except ImportError as error:
        raise PemError(
            f"model 'b-nn' needs the package pyro-ppl (pip install 'pemviz[bnn]'): {error}"
        ) from None
    pose_mean, pose_std = statistics_of(table.salient, table.features)
    inputs, outcomes = _as_tensors(table, pose_mean, pose_std)
    with single_thread(seed), pyro.get_param_store().scope():
        guide = _fit_guide(pyro, inputs, outcomes, on_progress=on_progress)
        with torch.no_grad():
            draws: list[Mapping[str, torch.Tensor]] = [guide() for _ in range(DRAWS)]
    members: list[NetworkPem] = []
    for draw in draws:
        layers = (
            Layer(weight=_double(draw[f"weight.{index}"]), bias=_double(draw[f"bias.{index}"]))
            for index in range(_BAYES_LAYERS)
        )
        members.append(NetworkPem(card, pose_mean, pose_std, tuple(layers), table.features))
    return EnsemblePem(card, tuple(members))


def _fit_guide(
    pyro: Any, inputs: torch.Tensor, outcomes: torch.Tensor, *, on_progress: Progress | None
) -> Any:
    """Maximise the evidence lower bound; gives the fitted guide."""
    sizes = ((HIDDEN_UNITS, len(inputs.T)), (HIDDEN_UNITS, HIDDEN_UNITS), (1, HIDDEN_UNITS))

    def model(batch: torch.Tensor, observed: torch.Tensor | None = None) -> None:
        hidden = batch
        for index, (outputs, width) in enumerate(sizes):
            standard = pyro.distributions.Normal(0.0, 1.0)
            weight = pyro.sample(f"weight.{index}", standard.expand([outputs, width]).to_event(2))
            bias = pyro.sample(f"bias.{index}", standard.expand([outputs]).to_event(1))
            hidden = hidden @ weight.T + bias
            hidden = torch.relu(hidden) if index < _BAYES_LAYERS - 1 else hidden
        with pyro.plate("obstacles", len(inputs), subsample_size=len(batch)):
            bernoulli = pyro.distributions.Bernoulli(logits=hidden[:, 0])
            pyro.sample("detected", bernoulli, obs=observed)

    autoguide = pyro.infer.autoguide
    guide = autoguide.AutoNormal(
        pyro.poutine.block(model, hide=["detected"]),
        init_scale=INITIAL_SCALE,
        init_loc_fn=autoguide.init_to_sample,
    )
    optimiser = pyro.optim.Adam({"lr": BAYES_LEARNING_RATE})
    inference = pyro.infer.SVI(model, guide, optimiser, pyro.infer.TraceMeanField_ELBO())
    for step, rows in enumerate(_batches(len(inputs)), start=1):
        inference.step(inputs[rows], outcomes[rows])
        if on_progress is not None:
            on_progress(step, BAYES_STEPS)
    # The guide draws on a batch's plate: give it a batch to draw on.
    return lambda: guide(inputs[:1])


def _batches(rows: int) -> Iterator[torch.Tensor]:
    """Row indices of each step: epochs in random order, remainders left out."""
    batch = min(BAYES_BATCH_ROWS, rows)
    done = 0
    while True:
        order = torch.randperm(rows)
        for start in range(0, rows - batch + 1, batch):
            if done == BAYES_STEPS:
                return
            done += 1
            yield order[start : start + batch]
