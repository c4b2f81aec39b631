"""Adaptive multiple importance sampling with generalised linear proposals.

Every stage's rollouts are kept and weighted as draws from the mixture of all proposals used
so far (adaptive multiple importance sampling: Cornuet, Marin, Mira, Robert 2012). With p the
perception error model, b(s) monomials of the state's features, and n_k of the N rollouts tau_i
drawn from proposal q_k::

    proposal  logit h_k(miss | s) = logit p(miss | s) + clip(beta_k . b(s), -12, 12)
              q_k(o | s) = (1 - d) h_k(o | s) + d p(o | s)
    weight    w_i = p(tau_i) / sum_k (n_k / N) q_k(tau_i)
    estimate  mu  = 1 / N sum_i 1[i violates] w_i

The first stage draws from a broad family of exploration proposals
(:mod:`pemviz.proposals.exploration`), which is q_0 as a whole, and every later one a share of its
rollouts. So many as pay are plain rollouts, from p itself
(:mod:`pemviz.sampling.mixture.plain`). The rest come from the newest proposal fitted to the
violations; where they look at more than three features a quarter of them have d raised to a tenth,
or, where rollouts all start alike and a failure takes few steps, half of them to 0.3. In the first
half of the stages, while the weights do not tell the probability of a violation well, a quarter
come from one fitted to the lowest level of robustness whose probability they do tell
(:mod:`pemviz.sampling.mixture.fit`).
Another quarter comes from proposals for failure modes that exploration proposals have met, and for
what violations come to when they are moved, as long as the rollouts cannot tell how much of the
estimate these have (:mod:`pemviz.sampling.mixture.explored`). With several rules each that was
broken has proposals of its own, in equal shares, and so has each conjunct of a rule, by what it has
of the estimate; a proposal and a rollout's likelihood go as far as the rule at hand is kept
(:mod:`pemviz.sampling.mixture.balance_heuristic`).

Latents, where the scenario takes any, are moved beside outcomes: exploration proposals move one at
a time up or down (:mod:`pemviz.proposals.exploration`), each fitted proposal has means of
its own, fitted with the same weights (:mod:`pemviz.proposals.latent_moves`), and q_k is the density
of both. Noise is moved at all steps, at some, or at one step of each rollout that nobody knows
(:mod:`pemviz.proposals.latent_moves`), whichever is likeliest. A quarter of the rollouts come from
a proposal that is fitted blind to the state, so that no step is left out where few are known.

A stage of very many rollouts is over once enough of them violate
(:mod:`pemviz.sampling.mixture.stages`), and proposals are fitted to a bounded number of them
(:mod:`pemviz.sampling.mixture.failure_modes`).

The share d is a defensive mixture (Hesterberg 1995), the weight the balance heuristic (Veach,
Guibas 1995). Before it enters a weight, q_k of the rollouts that it was fitted to is lowered by how
much the fit flatters them (:func:`pemviz.proposals.offset_logistic_fit.leave_one_out_loss`). The
unbiased figure beside the estimate is the same average over the final rollouts alone, with the sum
over what they were sampled from.
"""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.faults import of_no_rollouts
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.offset_logistic import PolynomialBasis, SignalFeatures, StateFeatures
from pemviz.sampling.estimates.diagnostics import not_absorbing
from pemviz.sampling.estimates.estimators import mixture_estimate
from pemviz.sampling.method import Foreseen, SurrogateLearning, final_stage, finished_or
from pemviz.sampling.mixture import rejuvenated, resampled, stages
from pemviz.sampling.mixture.balance_heuristic import Planned, Pool
from pemviz.sampling.mixture.estimate import (
    REPLICATE,
    adaptation,
    columns_of,
    disagreements,
    replicates,
)
from pemviz.sampling.mixture.explored import (
    against_chains,
    explored_fits,
    fits_to_unknown,
    with_explored,
    with_taught,
)
from pemviz.sampling.mixture.fit import Fit, FitSettings, next_proposals
from pemviz.sampling.mixture.plain import PlainRollouts
from pemviz.sampling.mixture.pooling import Terms, extended, first_basis, with_plain
from pemviz.sampling.mixture.rejuvenated import SHARE
from pemviz.sampling.mixture.stages import InParts, Joining, MixtureState, SampledStage
from pemviz.sampling.mixture.surrogate import FIRST_REPETITION, LearnedOnSurrogate, Surrogate
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.large_stages import LARGEST_PART, part_sizes
from pemviz.sampling.seeds import stage_seeds
from pemviz.sampling.subset.exploring import Explored, explore
from pemviz.simulators.latents import latent_counts
from pemviz.types import Estimate, ScoredRollouts, StageResult


@dataclass(frozen=True, kw_only=True)
class MixtureSampling:
    """Stage 0 explores, stages 1 to K learn, stage K + 1 draws from a frozen mixture.

    A large final batch takes further stages, a part each.

    Attributes:
        learning_stages: K.
        rollouts: In each stage but the last; at most, where they are more than ``enough``.
        final_rollouts: In the last.
        seed: Root of all randomness.
        features: What proposals look at; ``None``: all signals and time.
        settings: How proposals are fitted.
        largest_part: How many final rollouts are sampled at once.
        enough: Violations after which a stage of more rollouts, from which is learned, is over.
        chains: Rollouts a level of the chains that search for failure modes first; 0: none do.
        most_by_chains: Rollouts at most that they take, where few are left.
        most_moves: Rollouts at most that violations are moved by, where time is short, or likewise.
        surrogate: On which proposals are learned first; ``None``: there is none.
    """

    learning_stages: int
    rollouts: int
    final_rollouts: int
    seed: int
    features: StateFeatures | None = None
    settings: FitSettings = field(default_factory=FitSettings)
    largest_part: int = LARGEST_PART
    enough: int = LARGEST_PART // 2
    chains: int = 0
    most_by_chains: float = math.inf
    most_moves: float = math.inf
    surrogate: Surrogate | None = None
    name: str = "mixture"

    @property
    def stages(self) -> int:
        """Exploration, K learning stages and the final one, or its parts."""
        return self.learning_stages + 1 + len(self._final_sizes())

    def init(
        self, problem: Problem, *, repetition: int, plain: PlainRollouts | None = None
    ) -> MixtureState:
        """Nothing is sampled yet, but for plain rollouts that count beside the first stage's."""
        features = self.features or SignalFeatures(problem.simulator.signals)
        absorbing = problem.unsafe is not None or problem.monitor is not None
        return MixtureState(
            repetition=repetition,
            stage=0,
            features=features,
            absorbing=absorbing,
            turns=problem.turns,
            starts=latent_counts(problem.simulator).start,
            rules=stages.several_rules(problem),
            conjuncts=problem.conjuncts,
            lost=problem.lost,
            many=(self.learning_stages + 1) * self.rollouts > self.largest_part,
            before=plain,
            steps=problem.simulator.states - 1,
        )

    def step(self, problem: Problem, state: MixtureState) -> tuple[MixtureState, StageResult]:
        """Draw from the newest proposals; fit the next one unless the stage is the last."""
        steps = problem.simulator.states - 1
        last = self._is_last(state)
        if self.surrogate is not None and state.on_surrogate is None:
            found = self._learned_on(self.surrogate, problem, repetition=state.repetition)
            finished = problem.finished(state.repetition, 0)
            if finished is not None:
                found.check_same(finished.kept, name=self.surrogate.simulator.name)
            state = replace(state, on_surrogate=found, basis=found.basis)
        if self.chains and state.explored is None:
            state = replace(state, explored=self._explored(problem, state))
        sampled = self._sampled(problem, state)
        basis = state.basis or first_basis(sampled.joining.sample, state.features)
        component = self._components(state, sampled.count)
        pool = self._pooled(state, basis, sampled, component)
        if not last:
            state = self._with_moved(problem, state, sampled, component, pool)
        advanced = replace(
            state,
            stage=state.stage + 1,
            basis=basis,
            pool=pool,
            frozen=(*state.frozen, sampled.count) if last else (),
        )
        result = final_stage(
            repetition=state.repetition,
            stage=state.stage,
            scored=sampled.scored,
            sampled_from=stages.main_proposal(state, steps=steps) or PemProposal(),
            sampled=sampled.sampled,
        )
        for found in (state.on_surrogate, state.explored) if state.stage == 0 else ():
            if found is not None:
                result = replace(result, kept={**result.kept, **found.kept})
        if last:
            return advanced, result
        own = {**state.rejuvenated.kept, **state.resampled.kept}
        result = replace(result, kept={**result.kept, **own})
        return self._learned(
            advanced, result, first=0 if state.pool is None else state.pool.sampled
        )

    def learned_from_last(
        self, before: MixtureState, drawn: MixtureState, result: StageResult
    ) -> tuple[MixtureState, StageResult]:
        """What the last stage was, once this method has further ones, that is learned from.

        Args:
            before: The state before that stage, whose rollouts came in one part.
            drawn: The state after it.
            result: Of the stage.
        """
        pool, basis = drawn.pool, drawn.basis
        assert pool is not None  # noqa: S101  the stage joined it
        assert basis is not None  # noqa: S101  the first stage set it
        sampled = SampledStage(result.scored, None, Joining(result.scored))
        pool = self._pooled(before, basis, sampled, pool.component[drawn.final])
        learning = replace(drawn, pool=pool, frozen=())
        return self._learned(learning, result, first=drawn.final.start)

    def _learned(
        self, state: MixtureState, result: StageResult, *, first: int
    ) -> tuple[MixtureState, StageResult]:
        """With proposals fitted to the pool, whose rollouts from ``first`` on are the newest."""
        began = time.perf_counter()
        pool, basis = state.pool, state.basis
        assert pool is not None  # noqa: S101  a stage joined it
        assert basis is not None  # noqa: S101  the first stage set it
        plain = state.plain.after(pool, first=first, planned=self._planned_rollouts)
        fits = next_proposals(
            pool,
            basis,
            self.settings,
            defensive=stages.defence(state.steps),
            unknown=fits_to_unknown(
                state.rejuvenated,
                state.resampled,
                pool,
                terms=self._terms(state, basis),
                basis=basis,
                settings=self.settings,
            ),
            needed=state.rejuvenated.needed_misses,
            explores=self._explores(state.stage),
            for_final=self._is_last(state),
        )
        state, newest = replace(state, plain=plain), fits[-1]
        if state.on_surrogate is not None:
            fits = with_taught(fits, state.on_surrogate, pool=pool, stage=state.stage)
        state = self._with_explored(state, fits, basis)
        return state, replace(
            result,
            kind="pretrain" if state.stage == 1 else "learn",
            learned=stages.main_proposal(state, steps=state.steps),
            threshold=newest.threshold,
            elites=newest.elites,
            loss=fits[0].loss,
            timings_s={**result.timings_s, "fit": time.perf_counter() - began},
        )

    def _learned_on(
        self, surrogate: Surrogate, problem: Problem, *, repetition: int
    ) -> LearnedOnSurrogate:
        """All learning stages on a surrogate, in this process."""
        own = replace(
            self,
            surrogate=None,
            chains=0,
            learning_stages=surrogate.learning_stages,
            rollouts=surrogate.rollouts,
        )
        its_problem = surrogate.in_place(problem)
        state = own.init(its_problem, repetition=FIRST_REPETITION + repetition)
        with of_no_rollouts():  # of the stage that comes after
            while state.stage <= own.learning_stages:
                state, _ = own.step(its_problem, state)
        estimate = own.preview(state)
        if not estimate.failures:
            return LearnedOnSurrogate(estimate)
        return LearnedOnSurrogate(estimate, state.fits, state.basis)

    def _with_moved(
        self,
        problem: Problem,
        state: MixtureState,
        sampled: SampledStage,
        component: IntArray,
        pool: Pool,
    ) -> MixtureState:
        """With some of what the stage has met, and, where chains search, of what it sampled."""
        joining, watched = sampled.joining_beside(component), stages.watching(problem)
        finished = problem.finished(state.repetition, state.stage)
        kept = None if finished is None else finished.kept

        def seeds(key: int) -> np.random.SeedSequence:
            keys = state.repetition, key, state.stage
            return np.random.SeedSequence(self.seed, spawn_key=keys)

        most = min(SHARE * self._planned_rollouts, self.most_moves - state.resampled.simulated)
        met = state.rejuvenated.after(
            watched,
            joining.scored,
            component if joining.row is None else component[joining.row],
            most=int(most),
            seeds=seeds(rejuvenated.SPAWN_KEY),
            kept=kept,
        )
        state = replace(state, rejuvenated=met)
        if state.explored is None or not state.fits:
            return state
        drawn = state.resampled.after(
            watched,
            joining.scored,
            pool,
            tuning=state.explored.tuning,
            most=self.most_moves - state.moved,
            seeds=seeds(resampled.SPAWN_KEY),
            kept=kept,
            moves=self._moves(state),
        )
        return replace(state, resampled=drawn)

    def _moves(self, state: MixtureState) -> int:
        """Of each violation that is drawn: several where chains found no way, if time allows it."""
        if state.explored is None or not state.explored.is_poor:
            return 1
        left = max(self.learning_stages - state.stage, 1)
        spare = self.most_moves - state.moved - left * self.rollouts
        return int(np.clip(spare / (left * resampled.MOST), 1, resampled.MOVES))

    def _explored(self, problem: Problem, state: MixtureState) -> Explored:
        watched, finished = stages.watching(problem), problem.finished(state.repetition, 0)
        if finished is not None:
            found = Explored.of_kept(watched, finished.kept)
            if found is not None:
                return found
        return explore(
            watched,
            rollouts=self.chains,
            most=self.most_by_chains,
            seed=self.seed,
            repetition=state.repetition,
        )

    def _with_explored(
        self, state: MixtureState, fits: tuple[Fit, ...], basis: PolynomialBasis
    ) -> MixtureState:
        """With what the next stage samples from: fitted to the pool, and to what chains found."""
        explored, pool = state.explored, state.pool
        if explored is None or pool is None:
            return replace(state, fits=fits)
        own = state.explored_fits
        if state.stage == 1:
            terms = self._terms(state, basis)
            own = explored_fits(explored, terms=terms, basis=basis, settings=self.settings)
        fits = with_explored(fits, own, rollouts=pool.count)
        return replace(state, fits=fits, explored_fits=own)

    def _terms(self, state: MixtureState, basis: PolynomialBasis) -> Terms:
        return Terms(
            features=state.features,
            basis=basis,
            defensive=stages.defence(state.steps),
            turns=state.turns,
            starts=state.starts,
            rules=state.rules,
            many=state.many,
            conjuncts=state.conjuncts,
            lost=state.lost,
        )

    def under_rule(self, state: MixtureState, rule: str) -> MixtureState:
        """The same rollouts with the verdict of one rule."""
        pool = state.pool
        return state if pool is None else replace(state, pool=pool.under_rule(rule))

    def is_done(self, state: MixtureState) -> bool:
        """Whether the final rollouts are sampled."""
        return len(state.frozen) == len(self._final_sizes())

    def foreseen(self, state: MixtureState) -> Foreseen:
        """What is left of the stages; a large one that is learned from may be over sooner."""
        learning = max(self.learning_stages + 1 - state.stage, 0)
        final = sum(self._final_sizes()[len(state.frozen) :])
        return Foreseen(learning * self.rollouts + final, learning)

    def estimate(self, state: MixtureState) -> Estimate:
        """The estimate from all rollouts, and the unbiased one from the final batch.

        Raises:
            ValueError: The final rollouts are not drawn yet.
        """
        if state.pool is None or not self.is_done(state):
            message = "the final rollouts have not been sampled yet"
            raise ValueError(message)
        off = state.pool.correction_error
        return self._estimate(state, state.pool, final=state.final, correction_error=off)

    def preview(self, state: MixtureState) -> Estimate:
        """What the rollouts of the stages so far say, of which the newest is held to the others.

        Its error is that of sampling alone.

        Raises:
            ValueError: There are none.
        """
        if state.pool is None:
            message = "nothing has been sampled yet"
            raise ValueError(message)
        newest = slice(max(state.pool.sampled - self.rollouts, 0), None)
        return self._estimate(state, state.pool, final=newest)

    def _estimate(
        self, state: MixtureState, pool: Pool, *, final: slice, correction_error: float = 0.0
    ) -> Estimate:
        judged = pool.judged
        found = mixture_estimate(
            method=self.name,
            log_weight=judged.log_weight,
            violated=judged.violated,
            component=judged.component,
            log_p=judged.log_p,
            frozen_log_weight=pool.weights_among(final),
            frozen=final,
            adaptation=_adaptation(state),
            correction_error=correction_error,
            replicate=replicates(judged.component) if state.starts else None,
        )
        wrong = () if state.absorbing else (not_absorbing(),)
        disagree = disagreements(pool, final=final)
        if state.explored is not None and state.basis is not None:
            terms = self._terms(state, state.basis)
            disagree = (
                *disagree,
                *against_chains(state.explored, state.resampled, pool, found, terms=terms),
            )
        simulated = found.rollouts_simulated + state.searching
        found = replace(found, rollouts_simulated=simulated)
        return replace(found, diagnostics=(*found.diagnostics, *disagree, *wrong))

    def extended(self, *, stages: int, rollouts: int) -> "MixtureSampling":
        """The method with more learning stages, all yet to come with so many ``rollouts``."""
        return replace(self, learning_stages=self.learning_stages + stages, rollouts=rollouts)

    def surrogate_learning(self, state: MixtureState) -> SurrogateLearning | None:
        """What was learned before the first stage, if there was something to learn on."""
        surrogate, found = self.surrogate, state.on_surrogate
        if surrogate is None or found is None:
            return None
        estimate, name = found.estimate, surrogate.simulator.name
        return SurrogateLearning(name, estimate.rollouts_simulated, estimate.probability)

    def pooled_log_weight(self, state: MixtureState) -> FloatArray:
        """Log weights ``[N]`` of all rollouts by the balance heuristic, as they were sampled.

        NaN of those that hold in a large final batch, or in a large stage that is learned from and
        do not join the pool.
        """
        pool = state.pool
        return np.empty(0) if pool is None else pool.judged.log_weight

    def kept_columns(self, state: MixtureState) -> Mapping[str, AnyArray]:
        """What each rollout was sampled from, and its weights by the balance heuristic."""
        if state.pool is None:
            return {}
        columns = columns_of(state.pool, final=state.final, factor=_adaptation(state))
        if state.starts:
            columns[REPLICATE] = replicates(state.pool.component)
        return columns

    def _sampled(self, problem: Problem, state: MixtureState) -> SampledStage:
        """The next stage, as an interrupted run left it or else sampled."""
        seeds = stage_seeds(seed=self.seed, repetition=state.repetition, stage=state.stage)
        in_parts = self._in_parts
        if self._is_last(state) or in_parts is None:
            size = self.rollouts
            if self._is_last(state):
                size = self._final_sizes()[len(state.frozen)]
            component = self._components(state, size)
            scored = finished_or(
                problem,
                lambda: stages.sampled(problem, state, component, seeds=seeds),
                repetition=state.repetition,
                stage=state.stage,
            )
            return SampledStage(scored, None, Joining(scored))
        finished = problem.finished(state.repetition, state.stage)
        if finished is not None:
            problem.progress(self.rollouts, self.rollouts)
            return in_parts.restored(finished)
        own = seeds.spawn(len(in_parts.sizes))

        def part(counting: Problem, number: int, size: int) -> ScoredRollouts:
            component = self._components_of_part(state, size)
            return stages.sampled(counting, state, component, seeds=own[number])

        return in_parts.sample(problem, part)

    @property
    def _planned_rollouts(self) -> int:
        return (self.learning_stages + 1) * self.rollouts + self.final_rollouts

    @property
    def _in_parts(self) -> InParts | None:
        """How stages that are learned from are sampled, if they are large."""
        large = self.rollouts > self.enough
        return InParts(count=self.rollouts, enough=self.enough) if large else None

    def _is_last(self, state: MixtureState) -> bool:
        return state.stage > self.learning_stages

    def _final_sizes(self) -> tuple[int, ...]:
        return part_sizes(self.final_rollouts, largest=self.largest_part)

    def _explores(self, stage: int) -> bool:
        """Whether a stage belongs to the first half of those that learn."""
        return 2 * stage <= self.learning_stages

    def _components(self, state: MixtureState, count: int) -> IntArray:
        """What each of the next stage's ``count`` rollouts is sampled from, ``[count]``."""
        if self._is_last(state) or self._in_parts is None:
            return self._components_of_part(state, count)
        sizes = self._in_parts.sizes
        parts = {size: self._components_of_part(state, size) for size in set(sizes)}
        return np.concatenate([parts[size] for size in sizes])[:count]

    def _components_of_part(self, state: MixtureState, count: int) -> IntArray:
        """Likewise of rollouts that are sampled together."""
        known = len(state.pool.proposals) if state.pool else 1
        return stages.components(
            count,
            # the parts of the final batch after the first bring no proposal that is new
            first=1 + known - (len(state.fits) if state.frozen else 0),
            shares=[fit.share for fit in state.fits],
            explores=self._explores(state.stage),
            plain=state.plain.share,
        )

    def _pooled(
        self,
        state: MixtureState,
        basis: PolynomialBasis,
        sampled: SampledStage,
        component: IntArray,
    ) -> Pool:
        """The pool with the stage's rollouts."""
        new, last = () if state.frozen else state.fits, self._is_last(state)
        terms = self._terms(state, basis)
        pool = state.pool
        if pool is None and state.before is not None:
            pool = with_plain(state.before, terms)
        return extended(
            pool,
            sampled.joining if last else sampled.joining_beside(component),
            component=component,
            new=[(fit.moves, fit.optimism) for fit in new],
            terms=terms,
            last=last,
            planned=self._planned(state, last=last),
        )

    def _planned(self, state: MixtureState, *, last: bool) -> Planned | None:
        """The shares that a final batch in parts ends with; ``None`` elsewhere."""
        sizes, pool = self._final_sizes(), state.pool
        if not last or pool is None or len(sizes) == 1:
            return None
        return Planned.of(
            sizes,
            lambda size: self._components(state, size),
            before=pool.component[: pool.sampled - sum(state.frozen)],
            proposals=len(pool.proposals) + (0 if state.frozen else len(state.fits)),
        )


def _adaptation(state: MixtureState) -> float:
    return adaptation(
        turns=state.turns,
        starts=state.starts,
        searched=state.explored is not None,
        hard=state.is_hard_to_learn,
    )
