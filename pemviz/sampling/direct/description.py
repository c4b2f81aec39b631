"""What methods ``monte-carlo`` and ``naive`` are."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.config import ExperimentConfig
from pemviz.sampling.description import (
    MethodDescription,
    averaged,
    counted,
    final_budget,
    with_final_budget,
)

if TYPE_CHECKING:
    from pemviz.proposals.fixed import ConstantProposal, PemProposal
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.direct.method import DirectSampling


def _sampling_from(
    proposal: PemProposal | ConstantProposal, name: str, config: ExperimentConfig, back_end: BackEnd
) -> DirectSampling:
    from pemviz.sampling.direct.method import DirectSampling  # noqa: PLC0415  slow to import
    from pemviz.sampling.rollouts.large_stages import largest_part  # noqa: PLC0415  as above

    return DirectSampling(
        name=name,
        proposal=proposal,
        rollouts=config.final_rollouts,
        seed=config.seed,
        largest_part=largest_part(states=back_end.simulator.states),
    )


def _build_monte_carlo(config: ExperimentConfig, back_end: BackEnd) -> DirectSampling:
    from pemviz.proposals.fixed import PemProposal  # noqa: PLC0415  slow to import

    return _sampling_from(PemProposal(), MONTE_CARLO.name, config, back_end)


def _build_naive(config: ExperimentConfig, back_end: BackEnd) -> DirectSampling:
    from pemviz.proposals.fixed import ConstantProposal  # noqa: PLC0415  slow to import

    proposal = ConstantProposal(detection_probability=config.naive_detection_probability)
    return _sampling_from(proposal, NAIVE.name, config, back_end)


MONTE_CARLO = MethodDescription(
    name="monte-carlo",
    summary="rollouts from the error model itself: what plain simulation sees",
    build=_build_monte_carlo,
    recount=counted,
    remedy="pemviz record --method mixture",
    settings=frozenset({"final_rollouts"}),
    budget=final_budget,
    with_budget=with_final_budget,
    interval_basis="counts",
    stages="parts",
    stage_interval="binomial",
    follows_model=True,
    learning_words=(
        "Nothing is learned by this method: all rollouts are sampled from the error model (black), "
        "under which violations are rare."
    ),
)

NAIVE = MethodDescription(
    name="naive",
    summary="rollouts from one constant detection probability, weighted",
    build=_build_naive,
    recount=averaged,
    remedy="pemviz record --method mixture",
    settings=frozenset({"final_rollouts", "naive_detection_probability"}),
    budget=final_budget,
    with_budget=with_final_budget,
    stages="parts",
    curve_name="what rollouts are sampled from",
    learning_words=(
        "Nothing is learned by this method: all rollouts are sampled with one constant probability "
        "of detection (orange). Black: how likely the detector is to see what it "
        "looks for."
    ),
)
