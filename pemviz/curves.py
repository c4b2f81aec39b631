"""P(detected) against gap, of the perception error model and of a proposal; for any viewer.

A proposal may depend on more than the gap. Its curve is then drawn along the *typical path*:
at each gap, every other feature takes its mean over the states near that gap which given
rollouts passed through.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, FloatArray
from pemviz.sampling.rollout import LogitFunction
from pemviz.types import Proposal, RolloutBatch, Simulator, StateBatch

GAP = "gap"
STEP_M = 0.1
SMALLEST_END_M = 20.0
MARGIN = 4 / 3


@dataclass(frozen=True)
class DetectionCurves:
    """P(detected) along gaps, all arrays ``[G]``.

    Attributes:
        gap_m: Ascending gaps [m].
        pem: Under the perception error model.
        proposal: Under the proposal.
    """

    gap_m: FloatArray
    pem: FloatArray
    proposal: FloatArray


def gap_grid(simulator: Simulator) -> FloatArray:
    """Gaps ``[G]`` from contact to a third beyond the initial gap, at least 20 m, every 0.1 m."""
    initial_m = float(np.max(simulator.initial(count=1).signals[GAP]))
    end_m = max(SMALLEST_END_M, float(np.ceil(MARGIN * initial_m)))
    return np.linspace(0.0, end_m, round(end_m / STEP_M) + 1)


def pem_curve(*, simulator: Simulator, pem_logit: LogitFunction, gap_m: FloatArray) -> FloatArray:
    """P(detected) ``[G]`` of the perception error model at gaps ``[G]``, else as at the start."""
    states = initial_states(simulator, gap_m=gap_m)
    return np.asarray(expit(pem_logit(simulator.salient(states.signals))), dtype=np.float64)


def detection_curves(
    *,
    simulator: Simulator,
    pem_logit: LogitFunction,
    proposal: Proposal,
    gap_m: FloatArray,
    rollouts: RolloutBatch | None = None,
    rollout_weight: FloatArray | None = None,
) -> DetectionCurves:
    """Both curves at gaps ``[G]``.

    Args:
        simulator: Gives salient variables and the states' layout.
        pem_logit: The perception error model.
        proposal: The proposal.
        gap_m: Ascending gaps ``[G]`` [m].
        rollouts: Whose states give the typical path; without any, all other features are
            those of the initial state.
        rollout_weight: Weights ``[N]`` of the rollouts in the typical path; equal if ``None``.
    """
    if rollouts is None:
        states = initial_states(simulator, gap_m=gap_m)
    else:
        states = typical_states(rollouts, gap_m=gap_m, rollout_weight=rollout_weight)
    pem_logits = np.asarray(pem_logit(simulator.salient(states.signals)), dtype=np.float64)
    return DetectionCurves(
        gap_m=gap_m,
        pem=np.asarray(expit(pem_logits), dtype=np.float64),
        proposal=np.asarray(expit(proposal.logit(states, pem_logits)), dtype=np.float64),
    )


def initial_states(simulator: Simulator, *, gap_m: FloatArray) -> StateBatch:
    """The initial state, but at gaps ``[G]``."""
    states = simulator.initial(count=gap_m.size)
    return replace(
        states,
        step=np.zeros(gap_m.size, dtype=np.int64),
        signals={**states.signals, GAP: gap_m},
    )


def typical_states(
    rollouts: RolloutBatch, *, gap_m: FloatArray, rollout_weight: FloatArray | None = None
) -> StateBatch:
    """The typical path at gaps ``[G]``: weighted means of every feature but the gap.

    States are assigned to the nearest grid gap; grid gaps that no state is near take values
    interpolated between their neighbours, constant beyond the ends. Rollouts with weights
    that are all 0 count equally.
    """
    states = rollouts.decision_states()
    gaps = states.signals[GAP]
    weight = np.ones(rollouts.count) if rollout_weight is None else rollout_weight
    if not np.sum(weight) > 0.0:
        weight = np.ones(rollouts.count)
    edges = (gap_m[1:] + gap_m[:-1]) / 2
    index = np.searchsorted(edges, gaps.ravel())
    total = _sums(index, np.broadcast_to(weight[:, None], gaps.shape), gap_m.size)
    filled = total > 0.0

    def mean(values: AnyArray) -> FloatArray:
        spread = np.broadcast_to(values, gaps.shape)
        sums = _sums(index, spread * weight[:, None], gap_m.size)
        return np.interp(gap_m, gap_m[filled], sums[filled] / total[filled])

    def means(table: Any) -> dict[str, FloatArray]:
        return {name: mean(values) for name, values in table.items()}

    return StateBatch(
        step=np.rint(mean(states.step)).astype(np.int64),
        signals={**means(states.signals), GAP: gap_m},
        memory=means(states.memory),
    )


def _sums(index: AnyArray, weights: AnyArray, size: int) -> FloatArray:
    totals = np.bincount(index, weights=np.ravel(weights), minlength=size)
    return np.asarray(totals, dtype=np.float64)
