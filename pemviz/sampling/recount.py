"""Estimates that rest on the final stages alone, formed again from what a run folder keeps.

Methods' descriptions name these functions, and are read before anything slow is imported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pemviz.sampling.kept import KeptRepetition, Recounted
    from pemviz.sampling.rollouts.final_batch import WeighedRollouts


def _final_weighed(kept: KeptRepetition) -> WeighedRollouts:
    """The final stages' rollouts as an average needs them; where each stands does not matter."""
    import numpy as np  # noqa: PLC0415  slow to import

    from pemviz.sampling.rollouts.final_batch import WeighedRollouts  # noqa: PLC0415  as above

    chosen = kept.in_final
    return WeighedRollouts(
        count=kept.rollouts("final"),
        row=np.arange(int(chosen.sum())),
        log_weight=kept.log_weight[chosen],
        log_p=kept.log_p[chosen],
    )


def counted(kept: KeptRepetition) -> Recounted:
    """The share of violations among the final stages' rollouts."""
    from pemviz.sampling.estimates.estimate import monte_carlo_estimate  # noqa: PLC0415  slow
    from pemviz.sampling.kept import Recounted  # noqa: PLC0415  as above

    return Recounted(monte_carlo_estimate(_final_weighed(kept), method=kept.method))


def averaged(kept: KeptRepetition) -> Recounted:
    """The average weight of violations, likewise."""
    from pemviz.sampling.estimates.estimate import importance_sampling_estimate  # noqa: PLC0415
    from pemviz.sampling.kept import Recounted  # noqa: PLC0415

    return Recounted(
        importance_sampling_estimate(
            _final_weighed(kept), method=kept.method, rollouts_simulated=kept.rollouts()
        )
    )
