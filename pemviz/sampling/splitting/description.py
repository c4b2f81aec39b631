"""What method ``splitting`` is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.config import ExperimentConfig
from pemviz.sampling.description import MethodDescription, particle_budget, with_particle_budget

if TYPE_CHECKING:
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.kept import KeptRepetition, Recounted
    from pemviz.sampling.splitting.method import SplittingSampling


def _build(config: ExperimentConfig, back_end: BackEnd) -> SplittingSampling:  # noqa: ARG001
    from pemviz.sampling.splitting.method import SplittingSampling  # noqa: PLC0415  slow to import

    return SplittingSampling(stages=config.stages, rollouts=config.rollouts, seed=config.seed)


def _recounted(kept: KeptRepetition) -> Recounted:
    from pemviz.sampling.splitting.estimate import recounted  # noqa: PLC0415  slow to import

    return recounted(kept)


SPLITTING = MethodDescription(
    name="splitting",
    summary="adaptive multilevel splitting in independent runs, a check of the others",
    build=_build,
    recount=_recounted,
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
