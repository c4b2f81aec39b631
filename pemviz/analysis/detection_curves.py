"""P(detected) against gap, of the perception error model and of a proposal; for any viewer.

A proposal may depend on more than the gap. Its curve is then the mean of what it gives at the
states near each gap that given rollouts passed through.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from pemviz.arrays import FloatArray
from pemviz.pem import Pem
from pemviz.sampling.state.composed import first_logit
from pemviz.simulators.latents import begun
from pemviz.types import Proposal, RolloutBatch, Simulator, StateBatch

GAP = "gap"
STEP_M = 0.1
SMALLEST_END_M = 20.0
MARGIN = 4 / 3
PROBED_ROLLOUTS = 10


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


def gap_grid(simulator: Simulator, *, step_m: float = STEP_M) -> FloatArray:
    """Gaps ``[G]`` from 0 to a third beyond the initial gap, at least 20 m, every ``step_m``."""
    initial_m = float(np.max(begun(simulator, count=1).signals[GAP]))
    end_m = max(SMALLEST_END_M, float(np.ceil(MARGIN * initial_m)))
    return np.linspace(0.0, end_m, round(end_m / step_m) + 1)


def pem_curve(*, simulator: Simulator, pem: Pem, gap_m: FloatArray) -> FloatArray:
    """P(detected) ``[G]`` of the perception error model at gaps ``[G]``, else as at the start."""
    states = initial_states(simulator, gap_m=gap_m)
    return np.asarray(expit(first_logit(pem, simulator.salient(states.signals))), dtype=np.float64)


def detection_curves(
    *,
    simulator: Simulator,
    pem: Pem,
    proposal: Proposal,
    gap_m: FloatArray,
    rollouts: RolloutBatch | None = None,
    rollout_weight: FloatArray | None = None,
) -> DetectionCurves:
    """Both curves at gaps ``[G]``.

    Args:
        simulator: Gives salient variables and the states' layout.
        pem: The perception error model.
        proposal: What rollouts are sampled from.
        gap_m: Ascending ``[G]`` [m].
        rollouts: Whose states a proposal of more than the gap is averaged over; without any,
            all else is as in the initial state.
        rollout_weight: Weights ``[N]`` of the rollouts in that average; equal if ``None``.
    """
    states = initial_states(simulator, gap_m=gap_m)
    pem_logits = np.asarray(first_logit(pem, simulator.salient(states.signals)), dtype=np.float64)

    def detection(states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        return np.asarray(expit(proposal.logit(states, pem_logit)), dtype=np.float64)

    probability = detection(states, pem_logits)
    if rollouts is not None and not _needs_gap_alone(simulator, proposal, rollouts):
        probability = mean_near_gaps(
            detection(rollouts.decision_states(), rollouts.pem_logit),
            rollouts=rollouts,
            gap_m=gap_m,
            rollout_weight=rollout_weight,
        )
    return DetectionCurves(
        gap_m=gap_m, pem=np.asarray(expit(pem_logits), dtype=np.float64), proposal=probability
    )


def _needs_gap_alone(simulator: Simulator, proposal: Proposal, rollouts: RolloutBatch) -> bool:
    """Whether some of the rollouts' states get the same as the initial state at their gaps."""
    some = slice(0, PROBED_ROLLOUTS)
    states = rollouts.decision_states()
    gaps = states.signals[GAP][some]
    else_initial = initial_states(simulator, gap_m=gaps.ravel())
    pem_logits = rollouts.pem_logit[some]
    here = proposal.logit(states.take(some), pem_logits)
    there = proposal.logit(else_initial, pem_logits.ravel()).reshape(gaps.shape)
    return bool(np.array_equal(here, there))


def initial_states(simulator: Simulator, *, gap_m: FloatArray) -> StateBatch:
    """The initial state, but at gaps ``[G]``."""
    states = begun(simulator, count=gap_m.size)
    return replace(states, signals={**states.signals, GAP: gap_m})


def mean_near_gaps(
    values: FloatArray,
    *,
    rollouts: RolloutBatch,
    gap_m: FloatArray,
    rollout_weight: FloatArray | None = None,
) -> FloatArray:
    """Weighted mean ``[G]`` of ``values`` ``[N, T-1]`` over the states nearest to each gap.

    Grid gaps that no state is near take values interpolated between their neighbours, constant
    beyond the ends. Rollouts with weights that are all 0 count equally.
    """
    gaps = rollouts.decision_states().signals[GAP]
    weight = np.ones(rollouts.count) if rollout_weight is None else rollout_weight
    if not np.sum(weight) > 0.0:
        weight = np.ones(rollouts.count)
    spread = np.broadcast_to(weight[:, None], gaps.shape)
    index = np.searchsorted((gap_m[1:] + gap_m[:-1]) / 2, gaps.ravel())
    total = np.bincount(index, weights=spread.ravel(), minlength=gap_m.size)
    sums = np.bincount(index, weights=np.ravel(spread * values), minlength=gap_m.size)
    filled = total > 0.0
    mean = sums[filled] / total[filled]
    return np.interp(gap_m, gap_m[filled], mean)
