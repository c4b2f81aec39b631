"""The failure probability over memory times, or over frailties, each from one set of rollouts.

The simulator's answer to a chain of outcomes does not depend on the error model, and the chain's
probability p_m is known for every memory m of misses, a memory time tau and a frailty f: rollouts
drawn for one serve all. Families of exploration proposals come first
(:mod:`pemviz.proposals.exploration`), around independent misses, around bursts and around obstacles
that are hard to see. Then a proposal is fitted for one m after another, first for independent
misses, then for what is farther from them, since long bursts, obstacles hard to see and scattered
misses are different failure modes and none is a start for another; in between or in the end for
what is known least. Each fit learns from everything drawn before, reweighted to its own m, and adds
its rollouts to it. It is around the model of obstacles of one visibility u_k, the average of those
that it learns from. With n_k of all N rollouts drawn from proposal q_k::

    proposal  logit h_k(miss | s) = logit p_k(miss | s, u_k) + clip(beta_k . b(s), -12, 12)
              q_k(o | s) = (1 - d) h_k(o | s) + d p_k(o | s, u_k)
    weight    w_i(m) = p_m(o_i) / sum_k (n_k / N) q_k(o_i)
    estimate  mu(m)  = 1 / N sum_i 1[i violates] w_i(m)

with u integrated out of p_m (:mod:`pemviz.sampling.bursts.reweighting`). The weights are those of
the balance heuristic (Veach, Guibas 1995), over the outcomes before a violation: what comes after
does not decide whether there is one. Where no m has a memory time they are over the outcomes that
the scenario reacts to (:class:`pemviz.sampling.bursts.reweighting.Scenario`): on one scenario that
divides errors by three. As in method ``mixture`` all rollouts count (adaptive multiple importance
sampling: Cornuet, Marin, Mira, Robert 2012), and q_k of the rollouts that it was fitted to is
lowered by how much the fit flatters them.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config.ranges import AtLeastZero
from pemviz.pem import Pem
from pemviz.pem.models.memory import Memory
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.bursts import reweighting
from pemviz.sampling.bursts.reweighting import FittedAround, Given, Sampled, Scenario
from pemviz.sampling.estimates.diagnostics import not_absorbing, weight_diagnostics
from pemviz.sampling.estimates.estimators import StratifiedError, log_normal_interval
from pemviz.sampling.estimates.importance_weights import log_mean_failing_weight
from pemviz.sampling.estimates.trust import caveats
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size, weight_figures
from pemviz.sampling.mixture.estimate import disagreements
from pemviz.sampling.mixture.fit import FitSettings, failing_elites, fitted, smoothed
from pemviz.sampling.problem import Problem
from pemviz.sampling.state.composed import with_last_outcome
from pemviz.sampling.zero_variance.method import with_absorbing_violation
from pemviz.types import Diagnostic

MEASURED = {
    "RRC, a camera detector": Memory(0.25, 0.68),
    "PointRCNN, a lidar detector": Memory(0.11, 0.83),
}
"""Memory time and frailty of two detectors on KITTI's tracking sequences, fitted together, by
``pemviz pem fit --memory``. Both were trained on these drives."""
ALIKE_S = {"RRC, a camera detector": 0.3, "PointRCNN, a lidar detector": 0.17}
"""Memory times of the same [s] if all cars are taken to be equal: what frailty would explain passes
for memory then."""
SHOWN_S = (0.0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0)
"""Memory times at which the curve is shown [s]."""
EXPLORED_U = 2.0
"""The visibility that exploration proposals are around, where obstacles differ: one hard to see."""
LEAST_KNOWN = None
"""For what is known least by then."""
FITTED_S = (0.0, 0.0, 0.0, 0.01, 0.02, 0.02, 1.0, 0.3, 0.1, 0.05, 0.03, *[LEAST_KNOWN] * 8)
"""Memory times that proposals are fitted for, one after another [s]."""
FRAIL_FITTED_S = (
    *(0.0, 0.0, 0.02, 0.05, 0.1, 0.2, 1.0, 0.5, 0.05),
    *(LEAST_KNOWN, 0.0, LEAST_KNOWN, 0.05, LEAST_KNOWN, 0.15, LEAST_KNOWN, 0.5),
    *(LEAST_KNOWN, LEAST_KNOWN),
)
"""The same where obstacles differ: some of all late, for independence is not known least then."""
EXPLORED_S = (0.0, 0.1, 1.0)
"""Memory times whose models a family of exploration proposals is around, each [s]."""
MEASURED_FRAILTY = {name: memory.frailty for name, memory in MEASURED.items()}
"""Frailties of the measured detectors alone."""
SHOWN_FRAILTY = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2)
"""Frailties at which the curve is shown."""
FITTED_FRAILTY = (
    *(0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0),
    *(LEAST_KNOWN, 0.0, LEAST_KNOWN, 0.15, LEAST_KNOWN, 0.4, LEAST_KNOWN, 1.0),
    *(LEAST_KNOWN, LEAST_KNOWN),
)
"""Frailties that proposals are fitted for, one after another."""
EXPLORED_FRAILTY = ((0.0, 0.0), (0.5, 2.0), (1.0, 2.0))
"""Frailties and visibilities whose models a family of exploration proposals is around, each."""
EXPLORATION_SHARE = 1 / 18
"""Of all rollouts, from each family of exploration proposals."""
ROLLOUTS = 2400
SETTINGS = FitSettings(elites=40, ridge=1.0)
ADAPTATION = 1.15
"""Factor on the standard error between strata, for the proposals' own randomness. Over 22 seeds of
one scenario at 13 memory times errors were 1.08 times as large as the strata tell; over others
intervals with this factor held the exact value in 96 to 98 %."""
METHOD = "mixture"
"""Whose intervals the curve's are like, where diagnostics are judged."""
SEED_KEY = 2**32 - 3
FRAILTY_SEED_KEY = 2**32 - 4
POINTS_SEED_KEY = 2**32 - 5


def measured_s(frailty: float) -> dict[str, float]:
    """Memory times of the measured detectors [s], where obstacles are alike or have a frailty."""
    return ALIKE_S if frailty == 0.0 else {name: memory.tau_s for name, memory in MEASURED.items()}


@dataclass(frozen=True)
class CurvePoint:
    """The failure probability at one memory time and frailty.

    Attributes:
        tau_s: Memory time [s].
        probability: Estimate.
        low: Lower end of its 95 % interval; ``None`` if no rollout violates.
        high: Upper end; ``None`` likewise.
        ess: Effective sample size of the failing weights; ``None`` likewise.
        diagnostics: What is wrong with the estimate.
        frailty: Spread of obstacles' own visibility; 0: all are equal.
    """

    tau_s: AtLeastZero
    probability: AtLeastZero
    low: AtLeastZero | None
    high: AtLeastZero | None
    ess: AtLeastZero | None
    diagnostics: tuple[Diagnostic, ...] = ()
    frailty: AtLeastZero = 0.0

    @property
    def caveats(self) -> tuple[str, ...]:
        """Why ``low`` and ``high`` are no 95 % interval; empty if they are one."""
        return caveats(self.diagnostics, method=METHOD)


@dataclass(frozen=True)
class _Axis:
    """A way through memory times and frailties.

    Attributes:
        shown: Where the answer is given.
        sought: Those of them that proposals may be fitted for to know them better.
        fitted: What proposals are fitted for, one after another.
        late: So many of them sample what is compared with everything sampled before.
        explored: What exploration proposals are around.
        seed_key: Of its randomness.
    """

    shown: tuple[Memory, ...]
    sought: tuple[Memory, ...]
    fitted: tuple[Memory | None, ...]
    late: int
    explored: tuple[Given, ...]
    seed_key: int


def memory_curve(
    problem: Problem,
    *,
    pem: Pem,
    features: StateFeatures,
    seed: int,
    also_s: Sequence[float] = (),
    frailty: float = 0.0,
    rollouts: int = ROLLOUTS,
) -> tuple[CurvePoint, ...]:
    """The failure probability at the memory times SHOWN_S and ``also_s``, ascending.

    Args:
        problem: On a simulator without memory; its error model is not looked at.
        pem: The model of single outcomes.
        features: What the scenario offers to look at.
        seed: Root of all randomness.
        also_s: Further memory times [s].
        frailty: At all of them.
        rollouts: How many are simulated in all, 100 at least.

    Raises:
        ConfigError: The scenario has a signal named like the last outcome.
        SimulationError: A batch has something that is no finite number, or takes too long.
    """
    fitted_s, late, u = FITTED_S, 8, 0.0
    if frailty > 0.0:
        fitted_s, late, u = FRAIL_FITTED_S, 10, EXPLORED_U
    axis = _Axis(
        shown=tuple(Memory(tau_s, frailty) for tau_s in sorted({*SHOWN_S, *also_s})),
        sought=tuple(Memory(tau_s, frailty) for tau_s in SHOWN_S),
        fitted=tuple(None if at is None else Memory(at, frailty) for at in fitted_s),
        late=late,
        explored=tuple(Given(Memory(tau_s, frailty), u) for tau_s in EXPLORED_S),
        seed_key=SEED_KEY,
    )
    return _answers(axis, problem, pem=pem, features=features, seed=seed, rollouts=rollouts)


def frailty_curve(
    problem: Problem,
    *,
    pem: Pem,
    features: StateFeatures,
    seed: int,
    also: Sequence[float] = (),
    tau_s: float = 0.0,
    rollouts: int = ROLLOUTS,
) -> tuple[CurvePoint, ...]:
    """The failure probability at the frailties SHOWN_FRAILTY and ``also``, ascending.

    Arguments and errors are those of :func:`memory_curve`, with further frailties ``also`` and one
    memory time ``tau_s`` [s] at all of them.
    """
    axis = _Axis(
        shown=tuple(Memory(tau_s, frailty) for frailty in sorted({*SHOWN_FRAILTY, *also})),
        sought=tuple(Memory(tau_s, frailty) for frailty in SHOWN_FRAILTY),
        fitted=tuple(None if at is None else Memory(tau_s, at) for at in FITTED_FRAILTY),
        late=10,
        explored=tuple(Given(Memory(tau_s, frailty), u) for frailty, u in EXPLORED_FRAILTY),
        seed_key=FRAILTY_SEED_KEY,
    )
    return _answers(axis, problem, pem=pem, features=features, seed=seed, rollouts=rollouts)


def memory_points(
    problem: Problem,
    *,
    pem: Pem,
    features: StateFeatures,
    seed: int,
    memories: Sequence[Memory],
    rollouts: int,
) -> tuple[CurvePoint, ...]:
    """The failure probability at a few memories, in their order, all from the same rollouts.

    Arguments and errors are those of :func:`memory_curve`.
    """
    shown = tuple(dict.fromkeys(memories))
    axis = _Axis(
        shown=shown,
        sought=shown,
        fitted=(shown[0], *shown, LEAST_KNOWN, LEAST_KNOWN),
        late=2,
        explored=(*(Given(memory, EXPLORED_U) for memory in shown[:2]), Given(shown[0])),
        seed_key=POINTS_SEED_KEY,
    )
    found = _answers(axis, problem, pem=pem, features=features, seed=seed, rollouts=rollouts)
    by_memory = dict(zip(shown, found, strict=True))
    return tuple(by_memory[memory] for memory in memories)


def _answers(
    axis: _Axis, problem: Problem, *, pem: Pem, features: StateFeatures, seed: int, rollouts: int
) -> tuple[CurvePoint, ...]:
    absorbing = problem.unsafe is not None or problem.monitor is not None
    simulator = with_last_outcome(problem.simulator, tau_s=0.0)
    scenario = Scenario(
        problem=with_absorbing_violation(replace(problem, simulator=simulator)),
        pem=pem,
        own_features=features,
        memories=axis.shown,
        explored=axis.explored,
        forgetful=all(memory.tau_s == 0.0 for memory in axis.shown),
    )
    seeds = (
        np.random.SeedSequence(seed, spawn_key=(axis.seed_key, part)) for part in itertools.count()
    )
    scored = scenario.sampled_by_exploration(int(rollouts * EXPLORATION_SHARE), next(seeds))
    if scenario.forgetful and not reweighting.is_indifferent(scenario, scored.rollouts):
        scenario = replace(scenario, forgetful=False)
    scenario = replace(scenario, basis=reweighting.first_basis(scenario, scored))
    sampled = reweighting.described(scenario, scored, (), component=0)
    each, rest = divmod(rollouts - sampled.count, len(axis.fitted))
    counts = [each + (index < rest) for index in range(len(axis.fitted))]
    fits: list[FittedAround] = []
    for count, chosen in zip(counts, axis.fitted, strict=True):
        memory = _least_known(axis, sampled) if chosen is LEAST_KNOWN else chosen
        fit, optimism = _fitted(scenario, sampled, axis.shown.index(memory))
        fits.append(fit)
        scored = scenario.sampled_by_fit(fit, count, next(seeds))
        fresh = reweighting.described(scenario, scored, fits, component=len(fits))
        known = reweighting.with_fit(scenario, sampled, fit, optimism=optimism)
        sampled = reweighting.joined(known, fresh)
    late = slice(rollouts - sum(counts[-axis.late :]), rollouts)
    points = [_point(scenario, sampled, place, late=late) for place in range(len(axis.shown))]
    wrong = () if absorbing else (not_absorbing(),)
    return tuple(replace(one, diagnostics=(*one.diagnostics, *wrong)) for one in points)


def _least_known(axis: _Axis, sampled: Sampled) -> Memory:
    """The memory whose violating rollouts have the smallest effective sample size."""
    if not sampled.violated.any():
        return axis.sought[0]

    def effective(memory: Memory) -> float:
        log_weight = sampled.log_weight(axis.shown.index(memory))
        return effective_sample_size(log_weight[sampled.violated])

    return min(axis.sought, key=effective)


def _fitted(scenario: Scenario, sampled: Sampled, place: int) -> tuple[FittedAround, FloatArray]:
    """The proposal nearest to the elites' distribution under the model with a memory.

    It is around the visibility that the elites' obstacles have on average.

    Returns:
        The proposal, and by how much it flatters each of the rollouts ``[N]``.
    """
    pool = reweighting.seen_at(scenario, sampled, place)
    elites = failing_elites(pool.robustness, pool.violated, least=SETTINGS.elites)
    weight, _ = smoothed(pool, elites, SETTINGS)
    u = float(np.average(sampled.visibility[:, place], weights=weight))
    if u:
        pool = reweighting.seen_at(scenario, sampled, place, u=u)
    fit = fitted(pool, scenario.known_basis, elites, weight, SETTINGS)
    return FittedAround(Given(scenario.memories[place], u), fit.coefficients), fit.optimism


def _point(scenario: Scenario, sampled: Sampled, place: int, *, late: slice) -> CurvePoint:
    """The estimate for one memory; ``late`` are the rollouts that were sampled last."""
    memory, pool = scenario.memories[place], reweighting.seen_at(scenario, sampled, place)
    log_weight, violated = pool.log_weight, pool.violated
    failures = int(violated.sum())
    figures = weight_figures(log_weight[violated], of=sampled.count)
    log_mean = log_mean_failing_weight(log_weight, violated)
    wrong = weight_diagnostics(
        figures,
        failures=failures,
        rollouts=sampled.count,
        log10_probability=log_mean / math.log(10.0) if failures else None,
    )
    if not failures:
        return CurvePoint(memory.tau_s, 0.0, None, None, None, wrong, memory.frailty)
    error = StratifiedError.of(log_weight, violated, pool.component)
    of_sampling = ADAPTATION * math.exp(error.log_error - log_mean)
    relative_error = math.hypot(of_sampling, pool.correction_error)
    low, high = log_normal_interval(log_mean, relative_error=relative_error)
    wrong = (*wrong, *disagreements(pool, final=late))
    probability = math.exp(log_mean)
    return CurvePoint(memory.tau_s, probability, low, high, figures.ess, wrong, memory.frailty)
