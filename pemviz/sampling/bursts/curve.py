"""The failure probability as a function of the memory time, from one set of rollouts.

The simulator's answer to a chain of outcomes does not depend on the error model, and the chain's
probability p_tau is known for every memory time tau: rollouts drawn for one serve all. Proposals
are fitted for several tau, first for independent misses, then for ever shorter bursts, since long
bursts and scattered misses are different ways of failing and neither is a start for the other.
Each fit learns from everything drawn before, reweighted to its own tau. With n_k of the N final
rollouts drawn from proposal q_k::

    proposal  logit h_k(miss | s) = logit p_tau_k(miss | s) + clip(beta_k . b(s), -12, 12)
              q_k(o | s) = (1 - d) h_k(o | s) + d p_tau_k(o | s)
    weight    w_i(tau) = p_tau(o_i) / sum_k (n_k / N) q_k(o_i)
    estimate  mu(tau)  = 1 / N sum_i 1[i violates] w_i(tau)

The weights are those of the balance heuristic (Veach, Guibas 1995), over the outcomes before a
violation: what comes after does not decide whether there is one. No proposal was fitted to the
final rollouts, so that the average is unbiased.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray
from pemviz.config.ranges import AtLeastZero
from pemviz.pem import Pem
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.proposals.offset_logistic_fit import WeightedOutcomes, fit_offset_logistic
from pemviz.sampling.bursts.pool import (
    Drawing,
    Drawn,
    Scenario,
    described,
    first_basis,
    joined,
    log_weights,
    model_logit,
    simulated,
    with_drawing,
)
from pemviz.sampling.estimates.estimate import log_normal_interval, log_stratified_error
from pemviz.sampling.estimates.importance_weights import (
    effective_sample_size,
    log_mean_failing_weight,
    smoothed_weights,
)
from pemviz.sampling.memory import RememberingFeatures
from pemviz.sampling.mixture.fit import ridge_by_degree, smoothing_exponent
from pemviz.sampling.problem import Problem
from pemviz.sampling.value_twisted.method import with_latch
from pemviz.simulators.remembering import remembering

MEASURED_S = {"RRC, a camera detector": 0.3, "PointRCNN, a lidar detector": 0.17}
"""Memory times of two detectors on KITTI's tracking sequences [s], by ``pemviz pem memory``, if all
cars are taken to be alike; both were trained on these drives."""
SHOWN_S = (0.0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
"""Memory times at which the curve is told [s]."""
FITS = ((0.0, 3), (0.01, 2), (0.02, 2), (1.0, 2), (0.3, 2), (0.1, 2), (0.05, 2), (0.03, 2))
"""Memory times that proposals are fitted for [s], in this order, and how often each before its
last fit."""
EXPLORED = ((0.0, 2), (1.0, 1))
"""Memory times of the first rollouts [s], and how many thirtieths of all they take each."""
RAISED = (0.0, 2.0, 4.0, 6.0)
"""By how much the first proposals raise the logit of a miss, everywhere alike."""
ROLLOUTS = 2400
LEARNING_SHARE = 1 / 40
"""Of all rollouts, drawn between one fit and the next."""
PILOT_SHARE = 0.2
"""Of the final rollouts, from the first proposals: a way of failing that no fit has seen counts."""
ELITES = 40
ESS_SHARE = 0.1
RIDGE = 0.3
NEGLIGIBLE_SHARE = 1e-4
SEED_KEY = 2**32 - 3


@dataclass(frozen=True)
class CurvePoint:
    """The failure probability at one memory time.

    Attributes:
        tau_s: Memory time [s].
        probability: Estimate.
        low: Lower end of its 95 % interval; ``None`` if no rollout violates.
        high: Upper end; ``None`` likewise.
        ess: Effective sample size of the failing weights; ``None`` likewise.
    """

    tau_s: AtLeastZero
    probability: AtLeastZero
    low: AtLeastZero | None
    high: AtLeastZero | None
    ess: AtLeastZero | None


def memory_curve(
    problem: Problem,
    *,
    pem: Pem,
    features: StateFeatures,
    seed: int,
    also_s: Sequence[float] = (),
    rollouts: int = ROLLOUTS,
) -> tuple[CurvePoint, ...]:
    """The failure probability at the memory times SHOWN_S and ``also_s``, ascending.

    Args:
        problem: On a simulator without memory; its error model is not looked at.
        pem: The model of single outcomes.
        features: What the scenario offers to look at.
        seed: Root of all randomness.
        also_s: Further memory times [s].
        rollouts: How many are simulated in all.

    Raises:
        ConfigError: The scenario has a signal named like the last outcome.
        SimulationError: A batch has something that is no finite number, or takes too long.
    """
    scenario = Scenario(
        problem=with_latch(replace(problem, simulator=remembering(problem.simulator))),
        pem=pem,
        features=RememberingFeatures(features),
        own_features=features,
    )
    seeds = (np.random.SeedSequence(seed, spawn_key=(SEED_KEY, part)) for part in itertools.count())
    pilots = [Drawing(tau_s, np.array([up])) for tau_s, _ in EXPLORED for up in RAISED]
    shares = [share for _, share in EXPLORED for _ in RAISED]
    counts = [rollouts * share // (30 * len(RAISED)) for share in shares]
    scored = simulated(scenario, pilots, counts, next(seeds))
    scenario = replace(scenario, basis=first_basis(scenario, scored))
    drawn = described(scenario, scored, pilots, counts)
    drawings = pilots
    for tau_s, times in FITS:
        for _ in range(times):
            drawing = _fitted(scenario, drawn, tau_s)
            drawings = [*drawings, drawing]
            counts = [0] * (len(drawings) - 1) + [int(rollouts * LEARNING_SHARE)]
            fresh = _drawn(scenario, drawings, counts, next(seeds))
            drawn = joined(with_drawing(scenario, drawn, drawing), fresh)
    final = [*pilots, *(_fitted(scenario, drawn, tau_s) for tau_s, _ in FITS)]
    counts = _shared(rollouts - drawn.count, pilots=len(pilots), fits=len(FITS))
    frozen = _drawn(scenario, final, counts, next(seeds))
    return tuple(_point(scenario, frozen, tau_s) for tau_s in sorted({*SHOWN_S, *also_s}))


def _drawn(
    scenario: Scenario,
    drawings: Sequence[Drawing],
    counts: Sequence[int],
    seeds: np.random.SeedSequence,
) -> Drawn:
    return described(scenario, simulated(scenario, drawings, counts, seeds), drawings, counts)


def _shared(count: int, *, pilots: int, fits: int) -> list[int]:
    """How many of ``count`` rollouts come from each pilot and, of the rest, from each fit."""
    each = int(count * PILOT_SHARE) // pilots
    share, rest = divmod(count - each * pilots, fits)
    return [each] * pilots + [share + (index < rest) for index in range(fits)]


def _elites(drawn: Drawn) -> BoolArray:
    """The violating rollouts ``[N]``; where they are few, the least robust as well."""
    least = min(ELITES, max(1, drawn.count // 3))
    if int(drawn.violated.sum()) >= least:
        return drawn.violated
    level = float(np.partition(drawn.robustness, least - 1)[least - 1])
    return drawn.violated | (drawn.robustness <= max(level, 0.0))


def _fitted(scenario: Scenario, drawn: Drawn, tau_s: float) -> Drawing:
    """The proposal nearest to the elites' distribution under a memory time's model."""
    assert scenario.basis is not None  # noqa: S101  chosen from the first rollouts
    chosen = _elites(drawn)
    log_weight = log_weights(scenario, drawn, tau_s)[chosen]
    aim = min(max(ELITES, ESS_SHARE * chosen.sum()), chosen.sum() / 2)
    exponent = smoothing_exponent(log_weight, least_ess=float(aim))
    weight = np.zeros(drawn.count)
    weight[chosen] = smoothed_weights(log_weight, alpha=exponent)
    weight[chosen] *= effective_sample_size(exponent * log_weight)
    weight[weight < NEGLIGIBLE_SHARE * weight.max()] = 0.0
    of_outcome = weight[drawn.outcomes.rollout]
    kept = (of_outcome > 0.0) & (drawn.outcomes.near | (not scenario.is_short(tau_s)))
    outcomes = drawn.outcomes.take(kept)
    learned = WeightedOutcomes(
        basis=outcomes.basis,
        missed=outcomes.missed,
        offset=-model_logit(scenario, outcomes, tau_s),
        weight=of_outcome[kept],
    )
    start = np.zeros(outcomes.basis.shape[1])
    ridge = ridge_by_degree(scenario.basis, RIDGE)
    return Drawing(tau_s, fit_offset_logistic(learned, ridge=ridge, start=start).coefficients)


def _point(scenario: Scenario, frozen: Drawn, tau_s: float) -> CurvePoint:
    if not frozen.violated.any():
        return CurvePoint(tau_s, 0.0, None, None, None)
    log_weight = log_weights(scenario, frozen, tau_s)
    log_mean = log_mean_failing_weight(log_weight, frozen.violated)
    log_error = log_stratified_error(log_weight, frozen.violated, frozen.component)
    relative_error = math.exp(log_error - log_mean)
    low, high = log_normal_interval(log_mean, relative_error=relative_error)
    ess = effective_sample_size(log_weight[frozen.violated])
    return CurvePoint(tau_s, math.exp(log_mean), low, high, ess)
