"""Whether an error model fits a scenario: asked along whole rollouts, before a run starts."""

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import ConfigError
from pemviz.faults import told
from pemviz.pem import Pem
from pemviz.sampling.rollouts.simulate import replay
from pemviz.types import Simulator


def check_error_model(pem: Pem, simulator: Simulator) -> tuple[str, ...]:
    """Ask the error model about all states of two rollouts, all missed and all detected.

    Returns:
        Warnings: what looks wrong, but may be meant.

    Raises:
        ConfigError: It cannot answer, or its answer is no finite logit for each state.
    """
    outcomes = np.zeros((2, simulator.states - 1), dtype=np.bool_)
    outcomes[1] = True
    signals = replay(simulator=simulator, detected=outcomes)
    salient = simulator.salient({name: values[:, :-1] for name, values in signals.items()})
    where = f"pem = {pem.name!r} on simulator {simulator.name!r}"
    try:
        logit = np.asarray(pem.logit(salient))
    except BaseException as error:  # the user's code may raise anything
        message = f"{where}: {told(error)}"
        raise ConfigError(message) from error
    if logit.shape != salient.shape[:-1] or logit.dtype.kind != "f":
        message = (
            f"{where}: logit of salient variables {list(salient.shape)} has shape "
            f"{list(logit.shape)} and type {logit.dtype}: must be {list(salient.shape[:-1])} "
            "numbers of type float64"
        )
        raise ConfigError(message)
    if not np.isfinite(logit).all():
        odd = float(logit[~np.isfinite(logit)][0])
        message = (
            f"{where}: logit is {odd}: must be a finite number; 40 or -40 is as good as certain"
        )
        raise ConfigError(message)
    return _looks_like_probabilities(pem, logit)


def _looks_like_probabilities(pem: Pem, logit: FloatArray) -> tuple[str, ...]:
    """Logits that all lie in [0, 1] are more often probabilities than P(detected) of 50 to 73 %."""
    if logit.min() < 0.0 or logit.max() > 1.0:
        return ()
    return (
        f"error model {pem.name}: every logit lies between {logit.min():.3g} and "
        f"{logit.max():.3g}, as probabilities do; taken as logits they mean that "
        f"{_probability(logit.min()):.0%} to {_probability(logit.max()):.0%} are detected",
    )


def _probability(logit: float) -> float:
    return float(1.0 / (1.0 + np.exp(-logit)))
