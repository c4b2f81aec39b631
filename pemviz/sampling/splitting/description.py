"""What method ``splitting`` is."""

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
    from pemviz.sampling.splitting.run import Splitting  # noqa: PLC0415  as above

    return ParticleSampling(
        name=SPLITTING.name,
        of=Splitting(),
        stages=config.stages,
        rollouts=config.rollouts,
        seed=config.seed,
    )


SPLITTING = MethodDescription(
    name="splitting",
    summary="adaptive multilevel splitting in independent runs, a check of the others",
    build=_build,
    recount=between_runs,
    settings=frozenset({"stages", "rollouts"}),
    budget=particle_budget,
    with_budget=with_particle_budget,
    needs=frozenset({"restarts"}),
    interval_basis="runs",
    stages="runs",
    stage_interval="between runs",
    counting="level",
    follows_model=True,
    learning_words=(
        "Nothing is learned by this method: rollouts follow the error model (black). Those that "
        "come closest to a violation are cut and continued, level by level, in independent runs."
    ),
)
