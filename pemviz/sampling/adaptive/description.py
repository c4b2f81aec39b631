"""What method ``adaptive`` is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.config import ExperimentConfig
from pemviz.sampling.description import (
    MethodDescription,
    averaged,
    learning_budget,
    with_learning_budget,
)

if TYPE_CHECKING:
    from pemviz.sampling.adaptive.method import AdaptiveSampling
    from pemviz.sampling.back_end import BackEnd

PAPER_ALPHA = 0.1


def _build(config: ExperimentConfig, back_end: BackEnd) -> AdaptiveSampling:
    from pemviz.sampling.adaptive.method import AdaptiveSampling  # noqa: PLC0415  slow to import
    from pemviz.sampling.rollouts.large_stages import largest_part  # noqa: PLC0415  as above

    return AdaptiveSampling(
        learning_stages=config.stages,
        rollouts=config.rollouts,
        final_rollouts=config.final_rollouts,
        sigma=config.sigma,
        alpha=PAPER_ALPHA if config.alpha is None else config.alpha,
        epochs=config.epochs,
        learning_rate=config.learning_rate,
        seed=config.seed,
        largest_part=largest_part(states=back_end.simulator.states),
    )


ADAPTIVE = MethodDescription(
    name="adaptive",
    summary="the paper's Algorithm 1 to the letter: a network on the gap, learned from elites",
    build=_build,
    recount=averaged,
    settings=frozenset(
        {"alpha", "sigma", "stages", "rollouts", "final_rollouts", "epochs", "learning_rate"}
    ),
    budget=learning_budget,
    with_budget=with_learning_budget,
    needs=frozenset({"gap"}),
    remedy="pemviz record --method mixture",
    interval_caveat=(
        "on the paper's scenario a quarter to a third of this method's intervals contain the "
        "truth, as its weights degenerate"
    ),
    alpha=PAPER_ALPHA,
)
