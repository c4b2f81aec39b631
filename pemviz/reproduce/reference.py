"""The exact failure probability, which the paper lacked."""

from dataclasses import dataclass

from pemviz.config import ExperimentConfig
from pemviz.config_files import load_preset
from pemviz.pem import load_pem
from pemviz.reproduce.published import (
    AUTHORS_PEM_DIGEST,
    AUTHORS_PEM_PROBABILITY,
    AUTHORS_PEM_RELATIVE_ERROR,
)


@dataclass(frozen=True)
class Reference:
    """The true failure probability as far as it is known.

    Attributes:
        probability: The figure.
        std_error: Its standard error.
        source: Where it comes from, in words.
    """

    probability: float
    std_error: float
    source: str


def exact_reference(config: ExperimentConfig, rollouts: int) -> Reference | None:  # noqa: ARG001
    """The exact probability of ``config``'s experiment; ``None`` where it is not known."""
    paper = load_preset("paper")
    same = config.scenario == paper.scenario and config.spec == paper.spec
    if same and load_pem(config.pem).digest == AUTHORS_PEM_DIGEST:
        return Reference(
            probability=AUTHORS_PEM_PROBABILITY,
            std_error=AUTHORS_PEM_RELATIVE_ERROR * AUTHORS_PEM_PROBABILITY,
            source="computed independently for the authors' own network",
        )
    return None
