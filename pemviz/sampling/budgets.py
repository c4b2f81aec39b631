"""How many rollouts a method simulates, and settings with which it simulates a given number."""

from dataclasses import dataclass, replace

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError

LEAST_ROLLOUTS = 2
"""In a stage, a final batch or a run; as few as a configuration may ask for."""
LARGE_BUDGET = 2400
"""From here on the final batch of a method that learns takes half of the rollouts."""


@dataclass(frozen=True)
class Budget:
    """What one repetition simulates.

    Attributes:
        rollouts: How many rollouts; with splitting, how many particles, each of which is cut and
            continued as often as it takes.
        words: The same for reports, e.g. ``11 stages of 100 and 100 final rollouts``.
    """

    rollouts: int
    words: str


def learning_budget(config: ExperimentConfig) -> Budget:
    """A first stage, K learning stages, and a final batch."""
    stages = config.stages + 1
    return Budget(
        rollouts=stages * config.rollouts + config.final_rollouts,
        words=f"{stages} stages of {config.rollouts} and {config.final_rollouts} final rollouts",
    )


def with_learning_budget(config: ExperimentConfig, rollouts: int) -> ExperimentConfig:
    """The settings that spend ``rollouts`` on K + 1 stages alike, and the rest on a final batch.

    At 1,200 with K = 10 that is the paper's twelve times 100; from 2,400 on the final batch
    takes half.

    Raises:
        InputError: Too few rollouts for the stages.
    """
    stages = config.stages + 1
    parts = stages + 1 if rollouts < LARGE_BUDGET else 2 * stages
    share = _share(config, rollouts, parts=parts, least=LEAST_ROLLOUTS * (stages + 1))
    return replace(config, rollouts=share, final_rollouts=rollouts - share * stages)


def final_budget(config: ExperimentConfig) -> Budget:
    """A final batch alone."""
    return Budget(rollouts=config.final_rollouts, words=f"{config.final_rollouts} rollouts")


def with_final_budget(config: ExperimentConfig, rollouts: int) -> ExperimentConfig:
    """The settings that spend ``rollouts`` on a final batch.

    Raises:
        InputError: Too few rollouts.
    """
    _share(config, rollouts, parts=1, least=LEAST_ROLLOUTS)
    return replace(config, final_rollouts=rollouts)


def particle_budget(config: ExperimentConfig) -> Budget:
    """Independent runs of particles."""
    return Budget(
        rollouts=config.stages * config.rollouts,
        words=f"{config.stages} runs of {config.rollouts} particles",
    )


def with_particle_budget(config: ExperimentConfig, rollouts: int) -> ExperimentConfig:
    """The settings that share ``rollouts`` particles, as far as they go evenly, among the runs.

    Raises:
        InputError: Too few particles for the runs.
    """
    least = LEAST_ROLLOUTS * config.stages
    return replace(config, rollouts=_share(config, rollouts, parts=config.stages, least=least))


def _share(config: ExperimentConfig, rollouts: int, *, parts: int, least: int) -> int:
    if rollouts < least:
        message = f"rollouts = {rollouts}: must be at least {least} for {config.method}"
        raise InputError(message)
    return rollouts // parts
