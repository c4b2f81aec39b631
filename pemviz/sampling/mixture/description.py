"""What method ``mixture`` is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.config import ExperimentConfig
from pemviz.sampling.description import MethodDescription, learning_budget, with_learning_budget

if TYPE_CHECKING:
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.kept import KeptRepetition, Recounted
    from pemviz.sampling.mixture.method import MixtureSampling


def _build(config: ExperimentConfig, back_end: BackEnd) -> MixtureSampling:
    from pemviz.sampling.mixture.build import mixture_of  # noqa: PLC0415  slow to import

    return mixture_of(config, back_end)


def _recounted(kept: KeptRepetition) -> Recounted:
    from pemviz.sampling.mixture.estimate import recounted  # noqa: PLC0415  slow to import

    return recounted(kept)


MIXTURE = MethodDescription(
    name="mixture",
    summary="generalised linear proposals around the error model, all stages' rollouts kept",
    build=_build,
    recount=_recounted,
    is_checked=True,
    settings=frozenset(
        {"alpha", "sigma", "stages", "rollouts", "final_rollouts", "chains", "surrogate"}
    ),
    budget=learning_budget,
    with_budget=with_learning_budget,
)
