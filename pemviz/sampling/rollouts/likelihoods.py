"""Likelihoods of some of many rollouts."""

from pemviz.arrays import FloatArray, Rows, row_sums
from pemviz.types import RolloutBatch, outcome_log_likelihood


def log_p_of(rollouts: RolloutBatch, rows: Rows) -> FloatArray:
    """Log likelihood ``[M]`` of all outcomes of chosen rollouts under the error model [nats].

    Computed for these alone, unless it is known of all.
    """
    if "log_p" in vars(rollouts):
        return row_sums(rollouts.log_p[rows])
    return row_sums(outcome_log_likelihood(rollouts.pem_logit[rows], rollouts.detected[rows]))
