"""What method ``subset`` is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.config import ExperimentConfig
from pemviz.sampling.description import (
    MethodDescription,
    between_runs,
    particle_budget,
    with_particle_budget,
)

if TYPE_CHECKING:
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.particles.method import ParticleSampling


def _build(config: ExperimentConfig, back_end: BackEnd) -> ParticleSampling:  # noqa: ARG001
    from pemviz.sampling.particles.method import ParticleSampling  # noqa: PLC0415  slow to import
    from pemviz.sampling.subset.run import SubsetSimulation  # noqa: PLC0415  as above

    return ParticleSampling(
        name=SUBSET.name,
        of=SubsetSimulation(),
        stages=config.stages,
        rollouts=config.rollouts,
        seed=config.seed,
    )


SUBSET = MethodDescription(
    name="subset",
    summary="subset simulation in independent runs, a check that every system can have",
    build=_build,
    recount=between_runs,
    settings=frozenset({"stages", "rollouts"}),
    budget=particle_budget,
    with_budget=with_particle_budget,
    interval_basis="runs",
    stages="runs",
    stage_interval="between runs",
    counting="level",
    follows_model=True,
    learning_words=(
        "Nothing is learned by this method: rollouts follow the error model (black). Around those "
        "that come closest to a violation others are searched for, with some of their random "
        "numbers changed, level by level, in independent runs."
    ),
)
