"""The paper's B-NN: the ML-NN's layers without batch normalisation, weights random.

Mean-field Gaussian variational inference with standard normal priors, by the optional package
pyro-ppl. What is kept is a set of draws from the posterior, an ensemble whose mean probability
is the model's answer; running it needs no pyro.
"""

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any

import numpy as np
import torch

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.pem.data.table import SalientTable
from pemviz.pem.fitting.network import HIDDEN_UNITS, single_thread
from pemviz.pem.models.card import PemCard
from pemviz.pem.models.encoding import PAPER_INPUTS, paper_inputs, pose_statistics
from pemviz.pem.models.ensemble import EnsemblePem
from pemviz.pem.models.network import Layer, NetworkPem

STEPS = 1500
BATCH_ROWS = 1024
LEARNING_RATE = 1e-2
INITIAL_SCALE = 0.05
DRAWS = 30

RECIPE = (
    f"Linear(14,{HIDDEN_UNITS}) ReLU Linear({HIDDEN_UNITS},{HIDDEN_UNITS}) ReLU "
    f"Linear({HIDDEN_UNITS},1), standard normal priors, mean-field normal posterior by pyro "
    f"(AutoNormal, initial scale {INITIAL_SCALE:g}, TraceMeanField_ELBO), Adam "
    f"{LEARNING_RATE:g}, {STEPS} steps on batches of {BATCH_ROWS}, {DRAWS} posterior draws kept"
)

_SIZES = (
    (HIDDEN_UNITS, len(PAPER_INPUTS)),
    (HIDDEN_UNITS, HIDDEN_UNITS),
    (1, HIDDEN_UNITS),
)


def fit_bayes(
    table: SalientTable,
    *,
    card: PemCard,
    seed: int,
    on_progress: Callable[[int, int], None] | None = None,
) -> EnsemblePem:
    """Fit the posterior and draw members from it.

    Args:
        table: the training part; normalisation is fitted on it alone.
        card: the model's provenance.
        seed: of initial values, batches and draws.
        on_progress: told (steps done, steps in all).

    Raises:
        PemError: pyro-ppl is not installed.
    """
    pyro = _pyro()
    pose_mean, pose_std = pose_statistics(table.salient)
    inputs = paper_inputs(table.salient, pose_mean=pose_mean, pose_std=pose_std).T
    with single_thread(seed), pyro.get_param_store().scope():
        guide = _fit(
            pyro,
            inputs=torch.tensor(np.ascontiguousarray(inputs), dtype=torch.float32),
            outcomes=torch.tensor(table.detected, dtype=torch.float32),
            on_progress=on_progress,
        )
        with torch.no_grad():
            draws = [guide() for _ in range(DRAWS)]
    members = tuple(NetworkPem(card, pose_mean, pose_std, _layers(draw)) for draw in draws)
    return EnsemblePem(card, members)


def _pyro() -> Any:
    """The package pyro, with the modules of it that are used here."""
    try:
        for module in ("pyro.distributions", "pyro.infer.autoguide", "pyro.optim"):
            import_module(module)
        return import_module("pyro")
    except ImportError as error:
        raise PemError(
            f"model 'b-nn' needs the package pyro-ppl (pip install 'pemviz[bnn]'): {error}"
        ) from None


def _fit(
    pyro: Any,
    *,
    inputs: torch.Tensor,
    outcomes: torch.Tensor,
    on_progress: Callable[[int, int], None] | None,
) -> Any:
    """Maximise the evidence lower bound; gives the fitted guide."""

    def model(batch: torch.Tensor, observed: torch.Tensor | None = None) -> None:
        hidden = batch
        for index, (outputs, width) in enumerate(_SIZES):
            standard = pyro.distributions.Normal(0.0, 1.0)
            weight = pyro.sample(f"weight.{index}", standard.expand([outputs, width]).to_event(2))
            bias = pyro.sample(f"bias.{index}", standard.expand([outputs]).to_event(1))
            hidden = hidden @ weight.T + bias
            hidden = torch.relu(hidden) if index < len(_SIZES) - 1 else hidden
        with pyro.plate("obstacles", len(inputs), subsample_size=len(batch)):
            bernoulli = pyro.distributions.Bernoulli(logits=hidden[:, 0])
            pyro.sample("detected", bernoulli, obs=observed)

    autoguide = pyro.infer.autoguide
    guide = autoguide.AutoNormal(
        pyro.poutine.block(model, hide=["detected"]),
        init_scale=INITIAL_SCALE,
        init_loc_fn=autoguide.init_to_sample,
    )
    optimiser = pyro.optim.Adam({"lr": LEARNING_RATE})
    inference = pyro.infer.SVI(model, guide, optimiser, pyro.infer.TraceMeanField_ELBO())
    for step, rows in enumerate(_batches(len(inputs)), start=1):
        inference.step(inputs[rows], outcomes[rows])
        if on_progress is not None:
            on_progress(step, STEPS)
    # The guide draws on a batch's plate: give it a batch to draw on.
    return lambda: guide(inputs[:1])


def _batches(rows: int) -> Iterator[torch.Tensor]:
    """Row indices of each step: epochs in random order, remainders left out."""
    batch = min(BATCH_ROWS, rows)
    done = 0
    while True:
        order = torch.randperm(rows)
        for start in range(0, rows - batch + 1, batch):
            if done == STEPS:
                return
            done += 1
            yield order[start : start + batch]


def _layers(draw: Mapping[str, torch.Tensor]) -> tuple[Layer, ...]:
    def double(name: str) -> FloatArray:
        return draw[name].detach().numpy().astype(np.float64)

    return tuple(
        Layer(weight=double(f"weight.{index}"), bias=double(f"bias.{index}"))
        for index in range(len(_SIZES))
    )
