"""The exact failure probability, which the paper lacked."""

from dataclasses import dataclass, replace

from pemviz.config import ExperimentConfig
from pemviz.engine import run_experiment
from pemviz.sampling.diagnostics import unreliable_because


@dataclass(frozen=True)
class Reference:
    """The true failure probability.

    Attributes:
        probability: The figure.
        std_error: Its standard error.
        source: Where it comes from, in words.
    """

    probability: float
    std_error: float
    source: str


def exact_reference(config: ExperimentConfig, rollouts: int) -> Reference | None:
    """The exact probability of ``config``'s experiment, to a fraction of a per cent.

    Computed by the value-twisted method; ``None`` where the result is not to be relied on.
    """
    twisted = replace(
        config, method="value-twisted", metric="classical", final_rollouts=rollouts, repetitions=1
    )
    estimate = run_experiment(twisted).estimate
    if estimate is None or estimate.std_error is None or unreliable_because(estimate):
        return None
    return Reference(
        probability=estimate.probability,
        std_error=estimate.std_error,
        source=f"value-twisted, {rollouts} rollouts",
    )
