"""What method ``mixture`` is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.config import ExperimentConfig
from pemviz.sampling.description import MethodDescription, learning_budget, with_learning_budget

if TYPE_CHECKING:
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.kept import KeptRepetition, Recounted
    from pemviz.sampling.mixture.method import MixtureSampling

CHAINS = 200
"""Rollouts a level of chains, where they search."""


def _build(config: ExperimentConfig, back_end: BackEnd) -> MixtureSampling:
    from pemviz.sampling.mixture.fit import FitSettings  # noqa: PLC0415  as above
    from pemviz.sampling.mixture.method import MixtureSampling  # noqa: PLC0415  as above
    from pemviz.sampling.rollouts.large_stages import largest_part  # noqa: PLC0415  as above
    from pemviz.sampling.state.composed import proposal_features  # noqa: PLC0415  slow to import
    from pemviz.simulators.episodic import episodic  # noqa: PLC0415  as above
    from pemviz.simulators.latents import latent_counts  # noqa: PLC0415  as above

    simulator = back_end.simulator
    searches = bool(latent_counts(simulator)) and episodic(simulator) is None
    chains = CHAINS if searches else 0
    largest = largest_part(states=simulator.states)
    return MixtureSampling(
        learning_stages=config.stages,
        rollouts=config.rollouts,
        final_rollouts=config.final_rollouts,
        seed=config.seed,
        features=proposal_features(back_end.features),
        settings=FitSettings(alpha=config.alpha, sigma=config.sigma),
        largest_part=largest,
        enough=max(1, largest // 2),
        chains=chains if config.chains is None else config.chains,
    )


def _recounted(kept: KeptRepetition) -> Recounted:
    from pemviz.sampling.mixture.estimate import recounted  # noqa: PLC0415  slow to import

    return recounted(kept)


MIXTURE = MethodDescription(
    name="mixture",
    summary="generalised linear proposals around the error model, all stages' rollouts kept",
    build=_build,
    recount=_recounted,
    remedy="more rollouts; --method zero-variance or splitting beside it",
    remedy_with_latents="more rollouts; --method splitting beside it",
    settings=frozenset({"alpha", "sigma", "stages", "rollouts", "final_rollouts", "chains"}),
    budget=learning_budget,
    with_budget=with_learning_budget,
)
