"""Method ``mixture`` as a configuration has it, for those that use it too."""

from pemviz.config import ExperimentConfig
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.mixture.fit import FitSettings
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.mixture.surrogate import Surrogate
from pemviz.sampling.rollouts.large_stages import largest_part
from pemviz.sampling.slots import unrolled
from pemviz.sampling.state.composed import proposal_features
from pemviz.simulators.episodic import episodic
from pemviz.simulators.latents import latent_counts

CHAINS, CHAINS_OF_NOISE = 100, 200
"""Rollouts a level of chains, where they search; where each step has noise of its own, as there are
more combinations to be met."""
SURROGATE_TIMES = 4
"""Rollouts of a stage on a surrogate, for each of a stage on the simulator; where that is large,
fewer."""


def mixture_of(config: ExperimentConfig, back_end: BackEnd) -> MixtureSampling:
    """The method on a back end."""
    simulator = back_end.simulator
    # with slots, or one rollout at a time, the chains' few rollouts take as long as many
    one_by_one = episodic(simulator) is not None or unrolled(simulator) is not None
    latents = latent_counts(simulator)
    searches = bool(latents) and not one_by_one
    chains = (CHAINS_OF_NOISE if latents.noise else CHAINS) if searches else 0
    largest = largest_part(states=simulator.states)
    surrogate = None
    if back_end.surrogate is not None:
        rollouts = min(SURROGATE_TIMES * config.rollouts, max(1, largest // 2))
        surrogate = Surrogate(back_end.surrogate, config.stages, rollouts)
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
        surrogate=surrogate,
    )
