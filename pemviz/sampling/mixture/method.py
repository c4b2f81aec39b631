"""Adaptive multiple importance sampling with generalised linear proposals.

Every stage's rollouts are kept and weighted as draws from the mixture of all proposals used
so far (adaptive multiple importance sampling: Cornuet, Marin, Mira, Robert 2012). With p the
perception error model, b(s) monomials of the state's features, and n_k of the N rollouts tau_i
drawn from proposal q_k::

    proposal  logit h_k(miss | s) = logit p(miss | s) + clip(beta_k . b(s), -12, 12)
              q_k(o | s) = (1 - d) h_k(o | s) + d p(o | s)
    weight    w_i = p(tau_i) / sum_k (n_k / N) q_k(tau_i)
    estimate  mu  = 1 / N sum_i 1[i violates] w_i

The share d is a defensive mixture (Hesterberg 1995), the weight the balance heuristic (Veach,
Guibas 1995). Before it enters a weight, q_k of the rollouts that it was fitted to is lowered by how
much the fit flatters them (:func:`pemviz.proposals.offset_logistic_fit.leave_one_out_loss`). The
unbiased figure beside the estimate is the same average over the final rollouts alone, with the sum
over the two proposals that they were drawn from.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.proposals.defensive_share import share_for
from pemviz.proposals.offset_logistic import (
    OffsetLogisticProposal,
    PolynomialBasis,
    SignalFeatures,
    StateFeatures,
    acting,
)
from pemviz.sampling.estimates.diagnostics import unlatched
from pemviz.sampling.estimates.estimate import mixture_estimate
from pemviz.sampling.method import final_stage, finished_or, stage_seeds
from pemviz.sampling.mixture.balance_heuristic import Pool, balance_weights, extended
from pemviz.sampling.mixture.fit import Fit, FitSettings, fit_next
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.rollouts.final_batch import LARGEST_PART, part_sizes
from pemviz.sampling.value_twisted.method import with_latch
from pemviz.simulators.latched import VIOLATED
from pemviz.types import Estimate, Proposal, ScoredRollouts, StageResult, StateBatch

LADDER = (0.0, 2.0, 4.0, 6.0)
"""By how much the first proposals raise the logit of a miss, everywhere alike."""
DEFENSIVE_SHARE = 0.1
"""Of the final batch, drawn from the last but one proposal."""
DEFENSIVE_STEPS = 2.0
"""Of each rollout, drawn from the error model on average."""
DEGREE = 3


@dataclass(frozen=True)
class MixtureState:
    """Where a repetition stands.

    Attributes:
        repetition: Zero-based.
        stage: The stage that ``step`` carries out next.
        features: What proposals look at.
        basis: Monomials of it; ``None`` before the first stage.
        pool: Everything drawn so far.
        next_fit: What the next stage draws from; ``None`` before the first.
        frozen: How many rollouts each part of the final batch has, as far as it is drawn.
        latched: Whether rollouts know when they have violated.
    """

    repetition: int
    stage: int
    features: StateFeatures
    basis: PolynomialBasis | None = None
    pool: Pool | None = None
    next_fit: Fit | None = None
    frozen: tuple[int, ...] = ()
    latched: bool = True


@dataclass(frozen=True, kw_only=True)
class MixtureSampling:
    """Stage 0 explores, stages 1 to K learn, stage K + 1 draws from a frozen mixture.

    A large final batch takes further stages, a part each.

    Attributes:
        learning_stages: K.
        rollouts: In each stage but the last.
        final_rollouts: In the last.
        seed: Root of all randomness.
        features: What proposals look at; ``None``: all signals and time.
        settings: How proposals are fitted.
        largest_part: How many final rollouts are drawn at once.
    """

    learning_stages: int
    rollouts: int
    final_rollouts: int
    seed: int
    features: StateFeatures | None = None
    settings: FitSettings = field(default_factory=FitSettings)
    largest_part: int = LARGEST_PART
    name: str = "mixture"

    @property
    def stages(self) -> int:
        """Exploration, K learning stages and the final one, or its parts."""
        return self.learning_stages + 1 + len(self._final_sizes())

    def init(self, problem: Problem, *, repetition: int) -> MixtureState:
        """Nothing is drawn yet."""
        features = self.features or SignalFeatures(problem.simulator.signals)
        latched = problem.unsafe is not None or problem.monitor is not None
        return MixtureState(repetition=repetition, stage=0, features=features, latched=latched)

    def step(self, problem: Problem, state: MixtureState) -> tuple[MixtureState, StageResult]:
        """Draw from the newest proposals; fit the next one unless the stage is the last."""
        steps = problem.simulator.states - 1
        last = state.stage > self.learning_stages
        size = self._final_sizes()[len(state.frozen)] if last else self.rollouts
        plan = _plan(state, size, last=last)
        scored = finished_or(
            problem,
            lambda: _draw(
                with_latch(problem),
                [(_proposal(state, chosen, steps=steps), count) for chosen, count in plan],
                seeds=stage_seeds(seed=self.seed, repetition=state.repetition, stage=state.stage),
            ),
            repetition=state.repetition,
            stage=state.stage,
        )
        basis = state.basis or _basis(scored, state.features)
        advanced = replace(
            state,
            stage=state.stage + 1,
            basis=basis,
            pool=_pooled(state, basis, scored, plan, last=last),
            frozen=(*state.frozen, size) if last else (),
        )
        newest = _proposal(state, plan[0][0], steps=steps)
        result = final_stage(
            repetition=state.repetition, stage=state.stage, scored=scored, sampled_from=newest
        )
        if last:
            return advanced, result
        return self._learn(advanced, result, kind_of_first=state.stage == 0)

    def is_done(self, state: MixtureState) -> bool:
        """Whether the final rollouts are drawn."""
        return len(state.frozen) == len(self._final_sizes())

    def estimate(self, state: MixtureState) -> Estimate:
        """The estimate from all rollouts, and the unbiased one from the final batch.

        Raises:
            ValueError: The final rollouts are not drawn yet.
        """
        pool = state.pool
        if pool is None or not self.is_done(state):
            message = "the final rollouts have not been drawn yet"
            raise ValueError(message)
        final = slice(pool.count - sum(state.frozen), None)
        component = pool.component[final]
        found = mixture_estimate(
            method=self.name,
            log_weight=pool.log_weight,
            violated=pool.violated,
            component=pool.component,
            log_p=pool.log_p,
            frozen_log_weight=balance_weights(pool.log_ratio[final], component),
            frozen=final,
        )
        if state.latched:
            return found
        return replace(found, diagnostics=(*found.diagnostics, unlatched()))

    def pooled_log_weight(self, state: MixtureState) -> FloatArray:
        """Log weights ``[N]`` of all rollouts by the balance heuristic, as they were drawn."""
        pool = state.pool
        return np.empty(0) if pool is None else pool.log_weight

    def _final_sizes(self) -> tuple[int, ...]:
        return part_sizes(self.final_rollouts, largest=self.largest_part)

    def _learn(
        self, state: MixtureState, result: StageResult, *, kind_of_first: bool
    ) -> tuple[MixtureState, StageResult]:
        pool, basis = state.pool, state.basis
        assert pool is not None and basis is not None  # noqa: S101, PT018  just drawn
        drawn = time.perf_counter()
        fit = fit_next(pool, basis, self.settings)
        fitted = replace(state, next_fit=fit)
        return fitted, replace(
            result,
            kind="pretrain" if kind_of_first else "learn",
            learned=_proposal(
                fitted, fit.coefficients, steps=result.scored.rollouts.detected.shape[1]
            ),
            threshold=fit.threshold,
            elites=fit.elites,
            loss=fit.loss,
            timings_s={**result.timings_s, "fit": time.perf_counter() - drawn},
        )


Plan = Sequence[tuple[FloatArray, int]]


def _plan(state: MixtureState, count: int, *, last: bool) -> Plan:
    """Coefficients of the proposals to draw from, newest first, and how often from each."""
    if state.next_fit is None:
        share, rest = divmod(count, len(LADDER))
        steps = [(np.array([raised]), share) for raised in LADDER]
        return [*steps[:-1], (steps[-1][0], share + rest)]
    assert state.pool is not None  # noqa: S101  a fit comes from a pool
    # while it learns, the first stage's proposals are defence enough
    defensive = int(DEFENSIVE_SHARE * count) if last else 0
    return [
        (state.next_fit.coefficients, count - defensive),
        (state.pool.coefficients[-2 if state.frozen else -1], defensive),
    ]


def _proposal(
    state: MixtureState, coefficients: FloatArray, *, steps: int
) -> OffsetLogisticProposal:
    basis = state.basis
    if basis is None:  # the first proposals raise the logit by a constant: no features are used
        values = np.zeros(0)
        basis = PolynomialBasis(mean=values, spread=values, degree=0)
    return OffsetLogisticProposal(
        features=state.features if state.basis else _Blind(state.features),
        basis=basis,
        coefficients=coefficients,
        violated=VIOLATED,
        defensive=_defence(steps),
    )


@dataclass(frozen=True)
class _Blind:
    """Features that are not looked at; only whether the scenario reacts."""

    features: StateFeatures

    def values(self, states: StateBatch) -> FloatArray:
        return np.zeros((*next(iter(states.signals.values())).shape, 0))

    def reacts(self, states: StateBatch) -> BoolArray:
        return self.features.reacts(states)


def _draw(
    problem: Problem, plan: Sequence[tuple[Proposal, int]], *, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    total = sum(count for _, count in plan)
    parts: list[ScoredRollouts] = []
    done = 0
    for (proposal, count), child in zip(plan, seeds.spawn(len(plan)), strict=True):
        if count:
            told = replace(problem, progress=_after(problem, done, total))
            parts.append(sample(told, proposal=proposal, count=count, seeds=child))
            done += count
    return ScoredRollouts.concatenate(parts)


def _after(problem: Problem, before: int, total: int) -> Callable[[int, int], None]:
    return lambda done, _: problem.progress(before + done, total)


def _basis(scored: ScoredRollouts, features: StateFeatures) -> PolynomialBasis:
    """Standardised by the decisions of the first stage; a constant feature keeps spread 1."""
    states = scored.rollouts.decision_states()
    acts = acting(features, states, scored.rollouts.detected.shape, violated=VIOLATED)
    values = features.values(states)
    values = np.broadcast_to(values, (*acts.shape, values.shape[-1]))[acts]
    if values.shape[0] == 0:
        return PolynomialBasis(np.zeros(values.shape[1]), np.ones(values.shape[1]), DEGREE)
    spread = np.std(values, axis=0)
    return PolynomialBasis(
        mean=np.mean(values, axis=0), spread=np.where(spread > 0.0, spread, 1.0), degree=DEGREE
    )


def _pooled(
    state: MixtureState,
    basis: PolynomialBasis,
    scored: ScoredRollouts,
    plan: Plan,
    *,
    last: bool,
) -> Pool:
    counts = [count for _, count in plan]
    if state.pool is None:
        width = len(basis.exponents)
        new = [np.pad(raised, (0, width - 1)) for raised, _ in plan]
        index = np.repeat(np.arange(len(plan)), counts)
    else:
        # the parts of the final batch after the first bring no proposal that is new
        new = [] if state.frozen else [plan[0][0]]
        newest = len(state.pool.coefficients) + len(new) - 1
        index = np.repeat([newest, newest - 1], counts)
    return extended(
        state.pool,
        scored,
        drawn_from=index.astype(np.int64),
        new=new,
        optimism=None if state.next_fit is None else state.next_fit.optimism,
        defensive=_defence(scored.rollouts.detected.shape[1]),
        features=state.features,
        basis=basis,
        last=last,
    )


def _defence(steps: int) -> float:
    return share_for(drawn_steps=DEFENSIVE_STEPS, steps=steps)
