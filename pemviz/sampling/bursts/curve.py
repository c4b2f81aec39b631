"""The failure probability as a function of the memory time, from one set of rollouts.

The simulator's answer to a chain of outcomes does not depend on the error model, and the chain's
probability p_tau is known for every memory time tau: rollouts drawn for one serve all. Families of
pilots come first (:mod:`pemviz.proposals.pilots`), around independent misses and around bursts.
Then a proposal is fitted for one tau after another, first for independent misses, then for ever
shorter bursts, since long bursts and scattered misses are different ways of failing and neither is
a start for the other; in the end for whatever tau is known least. Each fit learns from everything
drawn before, reweighted to its own tau, and adds its rollouts to it. With n_k of all N rollouts
drawn from proposal q_k::

    proposal  logit h_k(miss | s) = logit p_tau_k(miss | s) + clip(beta_k . b(s), -12, 12)
              q_k(o | s) = (1 - d) h_k(o | s) + d p_tau_k(o | s)
    weight    w_i(tau) = p_tau(o_i) / sum_k (n_k / N) q_k(o_i)
    estimate  mu(tau)  = 1 / N sum_i 1[i violates] w_i(tau)

The weights are those of the balance heuristic (Veach, Guibas 1995), over the outcomes before a
violation: what comes after does not decide whether there is one. As in method ``mixture`` all
rollouts count (adaptive multiple importance sampling: Cornuet, Marin, Mira, Robert 2012), and q_k
of the rollouts that it was fitted to is lowered by how much the fit flatters them.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config.ranges import AtLeastZero
from pemviz.pem import Pem
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.bursts.pool import (
    Drawn,
    described,
    first_basis,
    joined,
    log_weights,
    seen_at,
    with_drawing,
)
from pemviz.sampling.bursts.scenario import Drawing, Scenario, drawn_by_fit, drawn_by_pilots
from pemviz.sampling.estimates.diagnostics import unlatched, weight_diagnostics
from pemviz.sampling.estimates.estimate import log_normal_interval, log_stratified_error
from pemviz.sampling.estimates.importance_weights import (
    effective_sample_size,
    log_mean_failing_weight,
    weight_figures,
)
from pemviz.sampling.estimates.trust import caveats
from pemviz.sampling.mixture.agreement import disagreements
from pemviz.sampling.mixture.fit import FitSettings, fitted, smoothing_exponent, weights_of
from pemviz.sampling.mixture.levels import failing_elites
from pemviz.sampling.problem import Problem
from pemviz.sampling.value_twisted.method import with_latch
from pemviz.simulators.remembering import remembering
from pemviz.types import Diagnostic

MEASURED_S = {"RRC, a camera detector": 0.3, "PointRCNN, a lidar detector": 0.17}
"""Memory times of two detectors on KITTI's tracking sequences [s], by ``pemviz pem memory``, if all
cars are taken to be alike; both were trained on these drives."""
SHOWN_S = (0.0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
"""Memory times at which the curve is told [s]."""
FITTED_S = (0.0, 0.0, 0.0, 0.01, 0.02, 0.02, 1.0, 0.3, 0.1, 0.05, 0.03)
"""Memory times that proposals are fitted for, one after another [s]."""
LEAST_KNOWN = 8
"""Further proposals, each for the memory time known least by then."""
PILOTS_SHARE = 1 / 18
"""Of all rollouts, from each family of pilots."""
ROLLOUTS = 2400
SETTINGS = FitSettings(elites=40, ridge=1.0)
ADAPTATION = 1.15
"""Factor on the standard error between strata, for the proposals' own randomness. Over 22 seeds of
one scenario at 13 memory times errors were 1.08 times as large as the strata tell; over others
intervals with this factor held the exact value in 96 to 98 %."""
METHOD = "mixture"
"""Whose intervals the curve's are like, where diagnostics are judged."""
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
        diagnostics: What is wrong with the estimate.
    """

    tau_s: AtLeastZero
    probability: AtLeastZero
    low: AtLeastZero | None
    high: AtLeastZero | None
    ess: AtLeastZero | None
    diagnostics: tuple[Diagnostic, ...] = ()

    @property
    def caveats(self) -> tuple[str, ...]:
        """Why ``low`` and ``high`` are no 95 % interval; empty if they are one."""
        return caveats(self.diagnostics, method=METHOD)


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
        rollouts: How many are simulated in all, 100 at least.

    Raises:
        ConfigError: The scenario has a signal named like the last outcome.
        SimulationError: A batch has something that is no finite number, or takes too long.
    """
    latched = problem.unsafe is not None or problem.monitor is not None
    scenario = Scenario(
        problem=with_latch(replace(problem, simulator=remembering(problem.simulator))),
        pem=pem,
        own_features=features,
    )
    seeds = (np.random.SeedSequence(seed, spawn_key=(SEED_KEY, part)) for part in itertools.count())
    scored = drawn_by_pilots(scenario, each=int(rollouts * PILOTS_SHARE), seeds=next(seeds))
    scenario = replace(scenario, basis=first_basis(scenario, scored))
    drawn = described(scenario, scored, (), component=0)
    counts = _divided(rollouts - drawn.count, len(FITTED_S) + LEAST_KNOWN)
    drawings: list[Drawing] = []
    for place, count in enumerate(counts):
        tau_s = FITTED_S[place] if place < len(FITTED_S) else _least_known(scenario, drawn)
        drawing, optimism = _fitted(scenario, drawn, tau_s)
        drawings.append(drawing)
        scored = drawn_by_fit(scenario, drawing, count=count, seeds=next(seeds))
        fresh = described(scenario, scored, drawings, component=len(drawings))
        drawn = joined(with_drawing(scenario, drawn, drawing, optimism=optimism), fresh)
    late = slice(rollouts - sum(counts[len(FITTED_S) :]), rollouts)
    told = [_point(scenario, drawn, tau_s, late=late) for tau_s in sorted({*SHOWN_S, *also_s})]
    wrong = () if latched else (unlatched(),)
    return tuple(replace(one, diagnostics=(*one.diagnostics, *wrong)) for one in told)


def _divided(count: int, parts: int) -> list[int]:
    each, rest = divmod(count, parts)
    return [each + (index < rest) for index in range(parts)]


def _least_known(scenario: Scenario, drawn: Drawn) -> float:
    """The memory time whose violating rollouts are worth the fewest."""
    if not drawn.violated.any():
        return SHOWN_S[0]

    def worth(tau_s: float) -> float:
        return effective_sample_size(log_weights(scenario, drawn, tau_s)[drawn.violated])

    return min(SHOWN_S, key=worth)


def _fitted(scenario: Scenario, drawn: Drawn, tau_s: float) -> tuple[Drawing, FloatArray]:
    """The proposal nearest to the elites' distribution under a memory time's model.

    Returns:
        The proposal, and by how much it flatters each of the rollouts ``[N]``.
    """
    basis, pool = scenario.basis, seen_at(scenario, drawn, tau_s)
    assert basis is not None  # noqa: S101  chosen from the pilots' rollouts
    elites = failing_elites(pool.robustness, pool.violated, least=SETTINGS.elites)
    aim = min(max(SETTINGS.elites, SETTINGS.ess_share * elites.count), elites.count / 2)
    exponent = smoothing_exponent(pool.log_weight[elites.chosen], least_ess=float(aim))
    weight = weights_of(pool, elites, exponent=exponent)
    fit = fitted(pool, basis, elites, weight, SETTINGS)
    return Drawing(tau_s, fit.coefficients), fit.optimism


def _point(scenario: Scenario, drawn: Drawn, tau_s: float, *, late: slice) -> CurvePoint:
    """The estimate at one memory time; ``late`` are the rollouts that were drawn last."""
    pool = seen_at(scenario, drawn, tau_s)
    log_weight, violated = pool.log_weight, pool.violated
    failures = int(violated.sum())
    figures = weight_figures(log_weight[violated])
    log_mean = log_mean_failing_weight(log_weight, violated)
    wrong = weight_diagnostics(
        figures,
        failures=failures,
        rollouts=drawn.count,
        log10_probability=log_mean / math.log(10.0) if failures else None,
    )
    if not failures:
        return CurvePoint(tau_s, 0.0, None, None, None, wrong)
    log_error = log_stratified_error(log_weight, violated, pool.component)
    relative_error = ADAPTATION * math.exp(log_error - log_mean)
    low, high = log_normal_interval(log_mean, relative_error=relative_error)
    wrong = (*wrong, *disagreements(pool, final=late))
    return CurvePoint(tau_s, math.exp(log_mean), low, high, figures.ess, wrong)
