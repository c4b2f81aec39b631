"""Outcomes of rollouts as the paper's network is trained on them, all at once."""

from pemviz.proposals.gap_network import OutcomeTable


def pool_outcomes(*, gap_m, detected, rollout_weight):
    """Of outcomes ``[N, T-1]``, of rollouts with weights ``[N]`` that sum to 1."""
    return OutcomeTable().with_rollouts(
        gap_m=gap_m, detected=detected, rollout_weight=rollout_weight
    )
