"""Estimates that rest on the final stages alone, formed again from what a run folder keeps."""

import numpy as np

from pemviz.sampling.estimates.estimate import importance_sampling_estimate, monte_carlo_estimate
from pemviz.sampling.kept import KeptRepetition, Recounted
from pemviz.sampling.rollouts.final_batch import WeighedRollouts


def final_weighed(kept: KeptRepetition) -> WeighedRollouts:
    """The final stages' rollouts as an average needs them; where each stands does not matter."""
    chosen = kept.in_final
    return WeighedRollouts(
        count=kept.rollouts("final"),
        row=np.arange(int(chosen.sum())),
        log_weight=kept.log_weight[chosen],
        log_p=kept.log_p[chosen],
    )


def counted(kept: KeptRepetition) -> Recounted:
    """The share of violations."""
    return Recounted(monte_carlo_estimate(final_weighed(kept), method=kept.method))


def averaged(kept: KeptRepetition) -> Recounted:
    """The average weight of violations."""
    return Recounted(
        importance_sampling_estimate(
            final_weighed(kept), method=kept.method, rollouts_simulated=kept.rollouts()
        )
    )
