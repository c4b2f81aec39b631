"""What method ``zero-variance`` is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.config import ExperimentConfig
from pemviz.sampling.description import MethodDescription, averaged, final_budget, with_final_budget

if TYPE_CHECKING:
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.zero_variance.method import ZeroVarianceSampling


def _build(config: ExperimentConfig, back_end: BackEnd) -> ZeroVarianceSampling:
    from pemviz.sampling.rollouts.large_stages import largest_part  # noqa: PLC0415  slow to import
    from pemviz.sampling.zero_variance.method import ZeroVarianceSampling  # noqa: PLC0415  as above

    assert back_end.twin is not None  # noqa: S101  it is among the needs
    return ZeroVarianceSampling(
        twin=back_end.twin,
        rollouts=config.final_rollouts,
        seed=config.seed,
        largest_part=largest_part(states=back_end.simulator.states),
    )


ZERO_VARIANCE = MethodDescription(
    name="zero-variance",
    summary="proposal from the exact value function of a fast twin",
    build=_build,
    recount=averaged,
    settings=frozenset({"final_rollouts"}),
    budget=final_budget,
    with_budget=with_final_budget,
    needs=frozenset({"twin", "single states"}),
    stages="parts",
    curve_name="optimal proposal",
    learning_words=(
        "Black: how likely the detector is to see the car ahead. Orange: the optimal proposal, "
        "computed from the probability of a violation from each state, along the typical path."
    ),
)
