"""What each rollout of a shown run contributes to the run's answer."""

import math

import numpy as np

from pemviz.analysis.causes import contributions
from pemviz.arrays import FloatArray
from pemviz.panel.run_data import RunData
from pemviz.panel.tables import final_violations
from pemviz.sampling.registry import by_name


def shares(run: RunData, *, rule: str | None = None) -> FloatArray:
    """The share ``[N]`` of the answer that each rollout of the final stages contributes.

    Of the answer to one rule, if it is given. All are 0 as long as no rollout of a final stage
    violates.
    """
    return run.memo.get(("shares", rule), lambda: _shares(run, rule=rule))


def log_contributions(run: RunData) -> FloatArray:
    """Log weights ``[N]`` by which violations of one or several stages compare [nats]."""
    return run.log_weight + _log_stage_weight(run)


def _shares(run: RunData, *, rule: str | None) -> FloatArray:
    violated = final_violations(run.rollouts, stages=run.result.stages, rule=rule)
    return contributions(log_contributions(run), violated=violated)


def _log_stage_weight(run: RunData) -> FloatArray:
    """Log weight ``[N]`` that a rollout has through its stage.

    Where stages are independent runs of rollouts without weights, the runs differ by many
    powers of ten: a run's estimate is shared by its violations.
    """
    rollouts = run.rollouts
    log_weight = np.zeros(rollouts["violated"].shape[0])
    if by_name(run.config.method).has_likelihood_ratios:
        return log_weight
    for stage in run.result.stages:
        if stage.log10_probability is not None and stage.failures:
            inside = (rollouts["repetition"] == stage.repetition) & (
                rollouts["stage"] == stage.stage
            )
            share = math.log(10.0) * stage.log10_probability - math.log(stage.failures)
            log_weight[inside] = share
    return log_weight
