"""Plain rollouts first, for as long as they pay; then proposals, until the answer is precise.

Nothing can deceive a binomial count, and where violations are frequent nothing is cheaper. So the
first stage is of plain rollouts, few beside what proposals take. If one of them violates, there are
so many more that a handful should. From F violations among n the number that a count of the wanted
relative half-width h takes is read::

    n_h = (1.96 / h)^2 (1 - p) / p, p = F / n

If it is within reach, as many are sampled and counted. Else all plain rollouts enter the pool of
:class:`pemviz.sampling.mixture.method.MixtureSampling`, whose every weight they bound. Before its
last stage its answer so far is looked at: where a diagnostic undermines it, or the half-width is
far from h, learning goes on with twice the rollouts; else the last stage has as many as h takes.
Its answer has to agree with the plain count.

What is chosen follows from counts alone, never from times: the same seed gives the same answer on
every machine.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from pemviz.arrays import AnyArray, FloatArray
from pemviz.binomial import exact_interval
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.estimates.diagnostics import plain_disagreement, undermining
from pemviz.sampling.estimates.estimators import CONFIDENCE, monte_carlo_estimate
from pemviz.sampling.method import final_stage, finished_or
from pemviz.sampling.mixture import stages
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.mixture.plain import PlainRollouts
from pemviz.sampling.mixture.stages import MixtureState
from pemviz.sampling.problem import FinishedStage, Problem, sample
from pemviz.sampling.rollouts.large_stages import WeighedRollouts, part_sizes, weighed
from pemviz.sampling.seeds import stage_seeds
from pemviz.types import Estimate, ScoredRollouts, StageResult

FIRST_STAGE = 2**31
"""Number of the first stage of plain rollouts where seeds are concerned: no method has as many."""
FEW_FAILURES = 10
"""Violations among plain rollouts from which on their share is known well enough."""
FAR_FACTOR = 3.0
"""Times the wanted half-width, beyond which more rollouts are to learn from, not only to count."""
PLAIN_CONFIDENCE = 0.999
"""Of the plain count's interval, in which the answer is to lie."""


@dataclass(frozen=True)
class PlainStage:
    """Plain rollouts: what a count needs of them, and what proposals do."""

    weighed: WeighedRollouts
    violating: ScoredRollouts


@dataclass(frozen=True)
class AutoState:
    """Where a repetition stands.

    Attributes:
        repetition: Zero-based.
        plain: The violations of each plain stage that is done.
        sizes: Of the plain stages that are the answer; empty where they are not, or not yet.
        first_counted: Which of the plain stages is the first of these.
        mixture: Where the method of proposals stands; ``None`` before it begins.
        method: It, with the stages and rollouts that it has come to.
    """

    repetition: int
    plain: tuple[PlainStage, ...] = ()
    sizes: tuple[int, ...] = ()
    first_counted: int = 0
    mixture: MixtureState | None = None
    method: MixtureSampling | None = None

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
        most: Rollouts at most that proposals draw.
        precision: Wanted half-width of the 95 % interval, as a share of the answer.
    """

    mixture: MixtureSampling
    first: int
    most_looked_at: int
    most_plain: int
    most: int
    precision: float
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
        if state.mixture is None or state.method is None:
            return self._plain_step(problem, state)
        before = len(state.plain)

        def finished(repetition: int, stage: int) -> FinishedStage | None:
            return problem.finished(repetition, stage + before)

        inner, result = state.method.step(replace(problem, finished=finished), state.mixture)
        method = state.method
        if inner.stage == method.learning_stages + 1 and not inner.frozen:
            method = self._gone_on(method, inner)
        return (
            replace(state, mixture=inner, method=method),
            replace(result, stage=result.stage + before),
        )

    def _plain_step(self, problem: Problem, state: AutoState) -> tuple[AutoState, StageResult]:
        stage = len(state.plain)
        seeds = stage_seeds(
            seed=self.mixture.seed, repetition=state.repetition, stage=FIRST_STAGE + stage
        )
        watched, size = stages.watching(problem), self._next_plain(state)
        scored = finished_or(
            problem,
            lambda: sample(watched, proposal=PemProposal(), count=size, seeds=seeds),
            repetition=state.repetition,
            stage=stage,
        )
        done = PlainStage(weighed(scored), scored.take(np.flatnonzero(scored.violated)))
        state = replace(state, plain=(*state.plain, done))
        if not state.sizes:
            state = self._decided(problem, state)
        result = final_stage(
            repetition=state.repetition, stage=stage, scored=scored, sampled_from=PemProposal()
        )
        return state, result if state.sizes else replace(result, kind="pretrain")

    def _next_plain(self, state: AutoState) -> int:
        """How many plain rollouts the next stage has, ahead of proposals or as the answer."""
        if state.sizes:
            return state.sizes[len(state.plain) - state.first_counted]
        if not state.plain:
            return self.first
        so_far = state.counted
        wanted = math.ceil(FEW_FAILURES * so_far.count / so_far.failures)
        return max(min(wanted, self.most_looked_at) - so_far.count, 1)

    def _decided(self, problem: Problem, state: AutoState) -> AutoState:
        """After plain rollouts: more to see their share, all that a count takes, or proposals."""
        so_far = state.counted
        failures, count = so_far.failures, so_far.count
        if 0 < failures < FEW_FAILURES and count < self.most_looked_at:
            return state
        wanted = math.inf
        if failures >= FEW_FAILURES:
            share, errors = failures / count, float(ndtri(0.5 + CONFIDENCE / 2.0))
            wanted = math.ceil((errors / self.precision) ** 2 * (1.0 - share) / share)
        if wanted <= self.most_plain:
            # those that were looked at last are the first that count
            last = state.plain[-1].weighed.count
            more = int(wanted) - last
            parts = part_sizes(more, largest=self.mixture.largest_part) if more > 0 else ()
            return replace(state, sizes=(last, *parts), first_counted=len(state.plain) - 1)
        violating = ScoredRollouts.concatenate([part.violating for part in state.plain])
        plain = PlainRollouts(count, so_far.row, violating)
        return replace(
            state,
            mixture=self.mixture.init(problem, repetition=state.repetition, plain=plain),
            method=self.mixture,
        )

    def _gone_on(self, method: MixtureSampling, inner: MixtureState) -> MixtureSampling:
        """Before the last stage: as many rollouts more as the answer so far asks for."""
        found, pool = method.preview(inner), inner.pool
        plain = 0 if inner.before is None else inner.before.count
        drawn = 0 if pool is None else pool.sampled - plain
        left = self.most - drawn
        half = _half_width(found)
        if undermining(found.diagnostics, basis="weights") or half > FAR_FACTOR * self.precision:
            more = max(self.mixture.learning_stages // 3, 1)
            if more * 2 * method.rollouts + self.mixture.final_rollouts <= left:
                return method.extended(stages=more, rollouts=2 * method.rollouts)
        if math.isfinite(half):
            wanted = drawn * ((half / self.precision) ** 2 - 1.0)
            final = int(min(max(wanted, self.mixture.final_rollouts), left))
            return replace(method, final_rollouts=max(final, self.mixture.final_rollouts))
        return method

    def is_done(self, state: AutoState) -> bool:
        """Whether the answer is there."""
        if state.sizes:
            return len(state.plain) == state.first_counted + len(state.sizes)
        if state.mixture is None or state.method is None:
            return False
        return state.method.is_done(state.mixture)

    def estimate(self, state: AutoState) -> Estimate:
        """The plain count, or the estimate by proposals, held against the count.

        Raises:
            ValueError: The last rollouts are not sampled yet.
        """
        counted = state.counted
        if state.mixture is None or state.method is None:
            return monte_carlo_estimate(counted, method="monte-carlo")
        found = state.method.estimate(state.mixture)
        low, high = exact_interval(counted.failures, counted.count, confidence=PLAIN_CONFIDENCE)
        plain = plain_disagreement(
            found.probability, low=low, high=high, failures=counted.failures, rollouts=counted.count
        )
        return replace(found, diagnostics=(*found.diagnostics, *plain))

    def under_rule(self, state: AutoState, rule: str) -> AutoState:
        """The same rollouts with the verdict of one rule."""
        own = [replace(part, weighed=part.weighed.under_rule(rule)) for part in state.plain]
        state = replace(state, plain=tuple(own))
        if state.mixture is None or state.method is None:
            return state
        return replace(state, mixture=state.method.under_rule(state.mixture, rule))

    def pooled_log_weight(self, state: AutoState) -> FloatArray:
        """Log weights ``[N]`` of all rollouts in order; NaN where one is not known."""
        if state.mixture is None or state.method is None:
            return np.zeros(sum(part.weighed.count for part in state.plain))
        return state.method.pooled_log_weight(state.mixture)

    def kept_columns(self, state: AutoState) -> Mapping[str, AnyArray]:
        """What the method of proposals keeps of each rollout."""
        if state.mixture is None or state.method is None:
            return {}
        return state.method.kept_columns(state.mixture)


def _half_width(found: Estimate) -> float:
    """Of the interval, as a share of the estimate; infinite where there is none."""
    if found.ci_low is None or found.ci_high is None or found.probability == 0.0:
        return math.inf
    return 0.5 * (found.ci_high - found.ci_low) / found.probability
