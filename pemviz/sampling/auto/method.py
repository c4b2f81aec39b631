"""Plain rollouts first, for as long as they pay; then proposals, until the answer is precise.

Nothing can deceive a binomial count, and where violations are frequent nothing is cheaper. So the
first stage is of plain rollouts, few beside what proposals take. If one of them violates, there are
so many more that a handful should. From F violations among n the number that a count of the wanted
relative half-width h takes is read::

    n_h = (1.96 / h)^2 (1 - p) / p, p = F / n

If it is within reach, as many are sampled and counted; with several rules F is that of the rarest,
so that none is left to a handful. Else all plain rollouts enter the pool of
:class:`pemviz.sampling.mixture.method.MixtureSampling`, whose every weight they bound. Before its
last stage its answers so far are looked at, with several rules that to each which a rollout has
broken: where a diagnostic undermines one, or a half-width is far from h, learning goes on with
twice the rollouts; else the last stage has as many as h takes.
If only that stage shows what undermines the answer, it is learned from too, and learning goes on,
as far as rollouts are left; but not from one so large that it comes in parts. The answer has to
agree with the plain count.

Where rollouts are limited, all are: the plain ones, those of proposals, and those of searches. What
is left before a stage decides as the time that is left does.

What is chosen follows from counts alone, so that the same seed gives the same answer on every
machine, unless a time is set. Then plain rollouts are cut off when it is over, and what proposals
sample is planned by what rollouts took so far. What the stages took, and the limits that they were
chosen under, are kept beside their rollouts: a run that goes on from them decides as it would have,
and one that goes on with other limits decides by these from where the old ones ended it.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import ndtri

from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.binomial import exact_interval
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.estimates.diagnostics import not_searched, plain_disagreement, undermining
from pemviz.sampling.estimates.estimators import CONFIDENCE, monte_carlo_estimate
from pemviz.sampling.method import Foreseen, SurrogateLearning, final_stage, finished_or
from pemviz.sampling.mixture import resampled, stages
from pemviz.sampling.mixture.balance_heuristic import Pool
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.mixture.plain import PlainRollouts
from pemviz.sampling.mixture.rejuvenated import SHARE
from pemviz.sampling.mixture.stages import MixtureState
from pemviz.sampling.problem import FinishedStage, Problem, no_progress, sample
from pemviz.sampling.rollouts.large_stages import WeighedRollouts, part_sizes, weighed
from pemviz.sampling.rollouts.losing import lost_rows
from pemviz.sampling.seeds import stage_seeds
from pemviz.types import Estimate, ScoredRollouts, StageResult

FIRST_STAGE = 2**31
"""Number of the first stage of plain rollouts where seeds are concerned: no method has as many."""
LOOKED_SHARE = 0.2
"""Of all rollouts, where they are limited: plain ones beside the first stage's until a way is
chosen."""
FEW_FAILURES = 10
"""Violations among plain rollouts from which on their share is known well enough."""
FREQUENT = 0.05
"""Share from which on a count that falls short is worth more than proposals that do: their error is
hardly the smaller, and it can be deceived."""
FAR_FACTOR = 3.0
"""Times the wanted half-width, beyond which more rollouts are to learn from, not only to count."""
MARGIN = 1.1
"""By which the last stage aims below the wanted half-width, as what it brings varies."""
IN_INTERVAL = float(ndtri(0.5 + CONFIDENCE / 2.0))
"""Standard errors in an interval's half-width."""
CHECKED_SHARE = 0.2
"""Of the rollouts that chains took, sampled at least in the last stage: they cost little beside."""
PLAIN_CONFIDENCE = 0.999
"""Of the plain count's interval, in which the answer is to lie."""
SECONDS, LIMITS = "seconds", "limits"
"""What each stage took, for a run that goes on with a time, and the limits it was chosen under."""
FEWEST_STAGES = 3
"""Of proposals, at least: one explores, one learns, one counts."""
FEWEST_ROLLOUTS = 60
"""Of each of these, below which nothing is learned; what time is left for no more counts plain
rollouts."""
CHAINS_COST = 18
"""Times the rollouts a level that chains take, about."""
LOOKS = 20
"""At the clock, in a stage of plain rollouts."""


@dataclass(frozen=True)
class Limits:
    """What an answer is to be, and may take.

    Attributes:
        precision: Wanted half-width of the 95 % interval, as a share of the answer.
        most: Rollouts at most that proposals draw.
        most_s: Seconds at most.
        most_in_all: Rollouts at most, plain ones and those of searches too.
    """

    precision: float
    most: int
    most_s: float = math.inf
    most_in_all: float = math.inf

    @property
    def kept(self) -> FloatArray:
        """As they are kept beside a stage, ``[4]``."""
        return np.array([self.precision, self.most, self.most_s, self.most_in_all])

    @classmethod
    def of_kept(cls, kept: AnyArray) -> Self:
        """From what was kept, by an earlier version without the last of them."""
        precision, most, *others = kept.tolist()
        return cls(precision, int(most), *others)


@dataclass(frozen=True)
class PlainStage:
    """Plain rollouts: what a count needs of them, and what proposals do.

    Attributes:
        weighed: All of them.
        row: Which violate, or are lost, ascending, ``[F]``.
        chosen: These.
    """

    weighed: WeighedRollouts
    row: IntArray
    chosen: ScoredRollouts


@dataclass(frozen=True)
class Proposing:
    """The method of proposals, with the stages and rollouts that it has come to, and its state."""

    method: MixtureSampling
    state: MixtureState


@dataclass(frozen=True)
class Took:
    """A stage's rollouts, and how long it took [s]."""

    count: int
    seconds: float


@dataclass(frozen=True)
class AutoState:
    """Where a repetition stands.

    Attributes:
        repetition: Zero-based.
        plain: The violations of each plain stage that is done.
        sizes: Of the plain stages that are the answer; empty where they are not, or not yet.
        first_counted: Which of the plain stages is the first of these.
        proposing: Where the method of proposals stands; ``None`` before it begins.
        took: What each stage took.
    """

    repetition: int
    plain: tuple[PlainStage, ...] = ()
    sizes: tuple[int, ...] = ()
    first_counted: int = 0
    proposing: Proposing | None = None
    took: tuple[Took, ...] = ()

    @property
    def stage(self) -> int:
        """Which comes next."""
        return len(self.took)

    @property
    def simulated(self) -> int:
        """Rollouts so far, those of searches too."""
        plain, proposing = sum(part.weighed.count for part in self.plain), self.proposing
        if proposing is None:
            return plain
        return plain + proposing.state.drawn + proposing.state.searching

    @property
    def counted(self) -> WeighedRollouts:
        """The plain rollouts that are the answer, or all."""
        return WeighedRollouts.concatenate(
            [part.weighed for part in self.plain[self.first_counted :]]
        )


@dataclass(frozen=True, kw_only=True)
class AutoSampling:
    """Plain rollouts, and proposals where these do not pay.

    Attributes:
        mixture: The method of proposals, with the stages and rollouts that it begins with.
        first: Plain rollouts of the first stage.
        most_looked_at: Plain rollouts at most until it is known whether they are the answer.
        most_plain: So many at most, if they are to be the answer.
        limits: How precise the answer is to be, and what it may take.
    """

    mixture: MixtureSampling
    first: int
    most_looked_at: int
    most_plain: int
    limits: Limits
    name: str = "auto"

    @property
    def stages(self) -> int:
        """Plain rollouts and the stages of the method of proposals; there may be others."""
        return 1 + self.mixture.stages

    def init(self, problem: Problem, *, repetition: int) -> AutoState:  # noqa: ARG002
        """Nothing is sampled yet."""
        return AutoState(repetition=repetition)

    def step(self, problem: Problem, state: AutoState) -> tuple[AutoState, StageResult]:
        """The next plain rollouts, or the next stage of proposals."""
        state, result = self._stepped(problem, state)
        counts = result.kind == "final" and state.proposing is None
        if counts and not self._stays_counted(problem, state):
            result = replace(result, kind="pretrain")
        return state, result

    def _stays_counted(self, problem: Problem, state: AutoState) -> bool:
        """Whether what is counted is the answer still where the finished stages end.

        A run that goes on with other limits may take to proposals after all.
        """
        quiet, stage = replace(problem, progress=no_progress), state.stage - 1
        while state.proposing is None and not self.is_done(state):
            if problem.finished(state.repetition, state.stage) is None:
                break
            state, _ = self._stepped(quiet, state)
        return bool(state.sizes) and stage >= state.first_counted

    def _stepped(self, problem: Problem, state: AutoState) -> tuple[AutoState, StageResult]:
        """As it goes by what the stages before leave."""
        began, left = time.perf_counter(), dict[str, AnyArray]()

        def finished(repetition: int, stage: int) -> FinishedStage | None:
            found = problem.finished(repetition, stage)
            if found is not None:
                left.update(found.kept)
            return found

        watched, stage = replace(problem, finished=finished), state.stage
        proposing = state.proposing
        if proposing is None:
            state, result = self._plain_step(watched, state, began_s=began)
        else:
            state, result = _proposing_step(watched, state, proposing)
        took_s = float(left.get(SECONDS, np.array(time.perf_counter() - began)))
        limits = left.get(LIMITS, self.limits.kept)
        state = replace(state, took=(*state.took, Took(result.count, took_s)))
        kept = {**result.kept, LIMITS: limits, SECONDS: np.array(took_s)}
        result = replace(result, kept=kept)
        following = problem.finished(state.repetition, stage + 1)
        decided_by = self.limits.kept if following is None else following.kept.get(LIMITS, limits)
        deciding = self if following is None else self._under(decided_by)
        goes_on = Limits.of_kept(limits) != Limits.of_kept(decided_by)
        return deciding._chosen(problem, state, result, proposing=proposing, goes_on=goes_on)

    def _under(self, kept: AnyArray) -> Self:
        """Under the limits that are kept beside a stage."""
        return replace(self, limits=Limits.of_kept(kept))

    def _chosen(
        self,
        problem: Problem,
        state: AutoState,
        result: StageResult,
        *,
        proposing: Proposing | None,
        goes_on: bool,
    ) -> tuple[AutoState, StageResult]:
        """What comes after a stage, before which proposals stood at ``proposing``.

        ``goes_on`` tells that the stage was chosen under other limits than what comes next.
        """
        if state.proposing is not None:
            if proposing is not None and self.is_done(state):
                return self._reconsidered(
                    state, proposing.state, state.proposing, result, goes_on=goes_on
                )
            return self._with_next_stages(state, state.proposing), result
        if not state.sizes or goes_on or self._is_over(state):
            state = self._decided(problem, state)
        return state, result if state.sizes else replace(result, kind="pretrain")

    def _left_s(self, state: AutoState) -> float:
        return self.limits.most_s - sum(stage.seconds for stage in state.took)

    def _is_over(self, state: AutoState) -> bool:
        return self._left_s(state) <= 0.0 or self.limits.most_in_all <= state.simulated

    def _within(self, state: AutoState) -> float:
        """Rollouts that are left, or that the time left is enough for, by the last stage's."""
        last, proposing = state.took[-1], state.proposing
        count = last.count
        if proposing is not None:
            count += proposing.state.searched_last
        in_time = self._left_s(state) * count / max(last.seconds, 1e-9)
        return min(in_time, self.limits.most_in_all - state.simulated)

    def _plain_step(
        self, problem: Problem, state: AutoState, *, began_s: float
    ) -> tuple[AutoState, StageResult]:
        stage, over_s = len(state.plain), began_s + self._left_s(state)
        seeds = stage_seeds(
            seed=self.mixture.seed, repetition=state.repetition, stage=FIRST_STAGE + stage
        )
        watched, size = stages.watching(problem), self._next_plain(problem, state)
        if math.isfinite(over_s):
            few = max(size // LOOKS, 1)
            watched = replace(watched, batch_rollouts=min(few, problem.batch_rollouts))
        scored = finished_or(
            problem,
            lambda: sample(
                watched,
                proposal=PemProposal(),
                count=size,
                seeds=seeds,
                is_over=lambda: time.perf_counter() >= over_s,
            ),
            repetition=state.repetition,
            stage=stage,
        )
        row = np.flatnonzero(scored.violated | lost_rows(scored.rollouts)).astype(np.int64)
        done = PlainStage(weighed(scored), row, scored.take(row))
        result = final_stage(
            repetition=state.repetition, stage=stage, scored=scored, sampled_from=PemProposal()
        )
        return replace(state, plain=(*state.plain, done)), result

    @property
    def _most_looked_at(self) -> int:
        """As the limits at hand have it: a run that goes on with others decided by its own."""
        return int(min(self.most_looked_at, LOOKED_SHARE * self.limits.most_in_all))

    def _next_plain(self, problem: Problem, state: AutoState) -> int:
        """How many plain rollouts the next stage has, ahead of proposals or as the answer."""
        if state.sizes:
            return state.sizes[len(state.plain) - state.first_counted]
        if not state.plain:
            return self.first
        so_far = state.counted
        wanted = math.ceil(FEW_FAILURES * so_far.count / _fewest_failures(problem, so_far))
        return max(min(wanted, self._most_looked_at) - so_far.count, 1)

    def _decided(self, problem: Problem, state: AutoState) -> AutoState:
        """After plain rollouts: more to see their share, all that a count takes, or proposals."""
        # those that were looked at last are the first that count
        first = state.first_counted if state.sizes else len(state.plain) - 1
        done = [part.weighed.count for part in state.plain[first:]]
        counting = replace(state, sizes=tuple(done), first_counted=first)
        if self._is_over(state):
            return counting
        so_far = state.counted
        failures, count = _fewest_failures(problem, so_far), so_far.count
        if 0 < failures < FEW_FAILURES and count < self._most_looked_at:
            return replace(state, sizes=(), first_counted=0)
        wanted, share = math.inf, failures / count
        if failures >= FEW_FAILURES:
            wanted = math.ceil((IN_INTERVAL / self.limits.precision) ** 2 * (1.0 - share) / share)
        within = self._within(state)
        if wanted > min(self.most_plain, within):
            counts = share >= FREQUENT and self.limits.most_in_all < wanted + state.simulated
            fewest = min(FEWEST_ROLLOUTS, self.mixture.rollouts)
            if within >= FEWEST_STAGES * fewest and not counts:
                return self._begun(problem, replace(state, sizes=(), first_counted=0), within)
            wanted = sum(done) + within
        more = int(wanted) - sum(done)
        parts = part_sizes(more, largest=self.mixture.largest_part) if more > 0 else ()
        return replace(counting, sizes=(*done, *parts))

    def _begun(self, problem: Problem, state: AutoState, within: float) -> AutoState:
        """With proposals, for whose stages the time left is enough."""
        counts = [part.weighed.count for part in state.plain]
        firsts = np.cumsum([0, *counts])[:-1].tolist()
        row = np.concatenate([p.row + first for p, first in zip(state.plain, firsts, strict=True)])
        chosen = ScoredRollouts.concatenate([part.chosen for part in state.plain])
        plain, method = PlainRollouts(sum(counts), row, chosen), self.mixture
        if within < FEWEST_STAGES * method.rollouts:
            method = replace(method, rollouts=int(within) // FEWEST_STAGES)
        if math.isfinite(within):
            method = _searching_less(method, int(within))
        begun = method.init(problem, repetition=state.repetition, plain=plain)
        return replace(state, proposing=Proposing(method, begun))

    def _with_next_stages(self, state: AutoState, proposing: Proposing) -> AutoState:
        """With as many stages and rollouts as the answer so far, and the time left, ask for."""
        method, inner = proposing.method, proposing.state
        if inner.frozen:
            return state
        surrogate, taught = self.mixture.surrogate, inner.on_surrogate
        if surrogate is not None and taught is not None and not taught.fits:
            stages = max(method.learning_stages, surrogate.learning_stages)
            method = replace(method, learning_stages=stages)  # as without one
        within = self._within(state)
        if inner.stage > 1 and within <= method.rollouts:
            method = replace(method, learning_stages=inner.stage - 1)  # none is left to learn from
        if inner.stage == method.learning_stages + 1:
            method = self._gone_on(state, method, inner)
        elif within < FEWEST_STAGES * method.rollouts:
            # what is learned from next is the last, as the stage that counts takes as much
            method = replace(method, learning_stages=max(inner.stage, 1))
        method = self._moving_less(state, method, inner)
        return replace(state, proposing=replace(proposing, method=method))

    def _moving_less(
        self, state: AutoState, method: MixtureSampling, inner: MixtureState
    ) -> MixtureSampling:
        """The method whose next stage moves no more than leaves a stage to learn, and the last."""
        if not math.isfinite(self.limits.most_in_all):
            return method
        others = FEWEST_STAGES - (inner.stage == method.learning_stages)
        after = self._within(state) - others * method.rollouts
        most = inner.moved + max(int(after), 0)
        return replace(method, most_moves=min(method.most_moves, most))

    def _gone_on(
        self, state: AutoState, method: MixtureSampling, inner: MixtureState
    ) -> MixtureSampling:
        """Before the last stage: as many rollouts more as the answers so far ask for."""
        found = _precise_answers(
            inner.rules,
            lambda rule: method.preview(method.under_rule(inner, rule) if rule else inner),
        )
        drawn, left, least = self._counts(state, inner)
        # what is hard to learn takes more rollouts than a first answer shows
        barely_learned = inner.is_hard_to_learn and method.rollouts == self.mixture.rollouts
        if barely_learned or self._is_far(found):
            longer = self._longer(method, left=left, least=least)
            if longer is not None:
                return longer
        half = max(each.relative_half_width for each in found)
        if not math.isfinite(half):
            last = left if math.isfinite(self.limits.most_in_all) else least
            return replace(method, final_rollouts=max(last, least))
        wanted = self._wanted(drawn, half, correction_error=_correction_error(inner.pool))
        if inner.explored is not None:
            wanted = max(wanted, CHECKED_SHARE * inner.explored.simulated)
        return replace(method, final_rollouts=max(int(min(wanted, left)), least))

    def _wanted(self, drawn: int, half: float, *, correction_error: float = 0.0) -> float:
        """Rollouts beside those that were drawn, which give the half-width ``half``.

        The square of sampling's half-width falls as one over their number, that of the correction's
        as one over its square: nothing is fitted to those that come, and it is of the others alone.
        """
        aim = (self.limits.precision / MARGIN) ** 2
        beside = (IN_INTERVAL * correction_error) ** 2
        share = 2.0 * aim / (half**2 + math.sqrt(half**4 + 4.0 * beside * aim))
        return drawn * (1.0 / share - 1.0)

    def _reconsidered(
        self,
        state: AutoState,
        before: MixtureState,
        proposing: Proposing,
        result: StageResult,
        *,
        goes_on: bool,
    ) -> tuple[AutoState, StageResult]:
        """After the last stage: learned from as well, if it shows what undermines the answer.

        Or, where the run goes on under other limits, if the answer is less precise than these ask.
        """
        method, inner = proposing.method, proposing.state
        found = _precise_answers(
            inner.rules, lambda rule: self.estimate(self.under_rule(state, rule) if rule else state)
        )
        half = max(each.relative_half_width for each in found)
        far = self._is_far(found)
        if len(inner.frozen) > 1 or not (far or (goes_on and half > self.limits.precision)):
            return state, result
        drawn, left, least = self._counts(state, inner)
        longer, final = self._longer(method, left=left, least=least) if far else None, least
        if longer is None:
            if not goes_on or left < least:
                return state, result
            wanted = self._wanted(drawn, half)
            longer, final = method, max(int(min(wanted, left)), least)
        # what was the last stage is one of those that learn
        longer = replace(longer, learning_stages=longer.learning_stages + 1, final_rollouts=final)
        inner, result = longer.learned_from_last(before, inner, result)
        longer = self._moving_less(state, longer, inner)
        return replace(state, proposing=Proposing(longer, inner)), result

    def _counts(self, state: AutoState, inner: MixtureState) -> tuple[int, int, int]:
        """Rollouts that proposals have drawn, that are left, and the last stage's at least."""
        drawn = inner.drawn
        left, least = self.limits.most - drawn, self.mixture.final_rollouts
        within, in_all = self._within(state), self.limits.most_in_all - state.simulated
        if math.isfinite(within):
            left = int(min(left, max(within, FEWEST_ROLLOUTS), max(in_all, 0)))
            least = max(int(min(least, max(left, FEWEST_ROLLOUTS), in_all)), 1)
        return drawn, left, least

    def _is_far(self, found: Sequence[Estimate]) -> bool:
        """Whether an answer asks for more to learn from, not only to count."""
        return any(
            undermining(each.diagnostics, basis="weights")
            or each.relative_half_width > FAR_FACTOR * self.limits.precision
            for each in found
        )

    def _longer(self, method: MixtureSampling, *, left: int, least: int) -> MixtureSampling | None:
        """The method with more stages of twice the rollouts, if so many are left.

        As long as more was learned on a surrogate, of as many rollouts: it has misled.
        """
        more, rollouts = max(self.mixture.learning_stages // 3, 1), 2 * method.rollouts
        surrogate = self.mixture.surrogate
        if surrogate is not None and method.learning_stages < surrogate.learning_stages:
            more, rollouts = self.mixture.learning_stages, method.rollouts
        if more * rollouts + least > left:
            return None
        return method.extended(stages=more, rollouts=rollouts)

    def is_done(self, state: AutoState) -> bool:
        """Whether the answer is there."""
        if state.sizes:
            return len(state.plain) == state.first_counted + len(state.sizes)
        proposing = state.proposing
        return proposing is not None and proposing.method.is_done(proposing.state)

    def foreseen(self, state: AutoState) -> Foreseen | None:
        """What is left of a count, or of proposals; ``None`` until either is chosen."""
        if state.sizes:
            return Foreseen(sum(state.sizes[len(state.plain) - state.first_counted :]))
        if state.proposing is None:
            return None
        method, inner = state.proposing.method, state.proposing.state
        found = method.foreseen(inner)
        left = max(self.limits.most_in_all - state.simulated, 0)
        rollouts, learning = min(found.rollouts, left), found.learning_stages
        searches = 0.0
        if method.chains:
            far = inner.explored is not None and inner.explored.is_poor
            searches += resampled.MOST * (resampled.MOVES if far else 1) * learning
        if inner.pool is None:
            searches += CHAINS_COST * method.chains + SHARE * rollouts
        searches = min(searches, left - rollouts)
        return Foreseen(int(rollouts), learning, int(searches), may_grow=learning > 0)

    def estimate(self, state: AutoState) -> Estimate:
        """The plain count, or the estimate by proposals, held against the count.

        Raises:
            ValueError: The last rollouts are not sampled yet.
        """
        counted = state.counted
        if state.proposing is None:
            found = monte_carlo_estimate(counted, method="monte-carlo")
            return replace(found, rollouts_simulated=state.simulated)
        found = state.proposing.method.estimate(state.proposing.state)
        low, high = exact_interval(counted.failures, counted.count, confidence=PLAIN_CONFIDENCE)
        plain = plain_disagreement(
            found.probability, low=low, high=high, failures=counted.failures, rollouts=counted.count
        )
        explored = state.proposing.state.explored
        is_searched = explored is not None and explored.log_probability.size
        missed = (not_searched(),) if self.mixture.chains and not is_searched else ()
        return replace(found, diagnostics=(*found.diagnostics, *plain, *missed))

    def under_rule(self, state: AutoState, rule: str) -> AutoState:
        """The same rollouts with the verdict of one rule."""
        own = [replace(part, weighed=part.weighed.under_rule(rule)) for part in state.plain]
        state = replace(state, plain=tuple(own))
        if state.proposing is None:
            return state
        method, inner = state.proposing.method, state.proposing.state
        return replace(state, proposing=Proposing(method, method.under_rule(inner, rule)))

    def pooled_log_weight(self, state: AutoState) -> FloatArray:
        """Log weights ``[N]`` of all rollouts in order; NaN where one is not known."""
        if state.proposing is None:
            return np.zeros(sum(part.weighed.count for part in state.plain))
        return state.proposing.method.pooled_log_weight(state.proposing.state)

    def surrogate_learning(self, state: AutoState) -> SurrogateLearning | None:
        """What proposals were learned on first, where there are any."""
        if state.proposing is None:
            return None
        return state.proposing.method.surrogate_learning(state.proposing.state)

    def kept_columns(self, state: AutoState) -> Mapping[str, AnyArray]:
        """What the method of proposals keeps of each rollout."""
        if state.proposing is None:
            return {}
        return state.proposing.method.kept_columns(state.proposing.state)


def _proposing_step(
    problem: Problem, state: AutoState, proposing: Proposing
) -> tuple[AutoState, StageResult]:
    """The next stage of the method of proposals, numbered from the plain ones on."""
    before = len(state.plain)

    def finished(repetition: int, stage: int) -> FinishedStage | None:
        return problem.finished(repetition, stage + before)

    inner, result = proposing.method.step(replace(problem, finished=finished), proposing.state)
    state = replace(state, proposing=replace(proposing, state=inner))
    return state, replace(result, stage=result.stage + before)


def _searching_less(method: MixtureSampling, within: int) -> MixtureSampling:
    """The method where no more than ``within`` rollouts are left."""
    chains = min(method.chains, within // (2 * CHAINS_COST))
    chains = chains if chains >= min(FEWEST_ROLLOUTS, method.chains) else 0
    left = within - FEWEST_STAGES * method.rollouts
    by_chains = min(within // 2, left) if chains else 0
    moves = min(int(SHARE * within), left - by_chains)
    return replace(method, chains=chains, most_by_chains=by_chains, most_moves=moves)


def _correction_error(pool: Pool | None) -> float:
    """The largest of any answer, see :attr:`Pool.correction_error`."""
    if pool is None:
        return 0.0
    under = [pool.under_rule(rule) for rule in pool.broken]
    return max(each.correction_error for each in (pool, *under))


def _precise_answers(
    rules: Sequence[str], answer: Callable[[str | None], Estimate]
) -> tuple[Estimate, ...]:
    """The answers that are to be precise: to any rule, and to each that a rollout has broken."""
    own = (answer(rule) for rule in rules)
    return (answer(None), *(found for found in own if found.failures))


def _fewest_failures(problem: Problem, counted: WeighedRollouts) -> int:
    """How many violate; of several rules, how many break the one that the fewest break."""
    rules = stages.several_rules(problem)
    return min([counted.under_rule(rule).failures for rule in rules] or [counted.failures])
