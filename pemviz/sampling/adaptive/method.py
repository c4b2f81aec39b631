"""State-dependent adaptive importance sampling: the paper's Algorithm 1.

Innes & Ramamoorthy, arXiv 2209.09674; a cross-entropy method (de Boer, Kroese, Mannor, Rubinstein
2005) whose proposal sees the state. With p the perception error model, q_phi the proposal, o_t the
outcome at state s_t and r_i the robustness of rollout i::

    weight     w_i     = prod_t p(o_t | s_t) / q_phi(o_t | s_t)
    threshold  gamma_k = max(0, lower 1 - sigma quantile of r_1 .. r_N)
    learning   phi_k   = argmin_phi - sum_{i: r_i <= gamma_k} w_i^alpha sum_t log q_phi(o_t | s_t)
    estimate   mu      = 1 / N_e sum_i 1[i violates] w_i

Stage 0 draws from p and learns from all its rollouts alike (alpha 0, no threshold). The training
weights are divided by their sum; the estimate is of the final rollouts alone.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from pemviz.arrays import AnyArray, Batch, BoolArray, FloatArray
from pemviz.drawn import Drawn
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.gap_network import (
    GapNetwork,
    OutcomeSums,
    OutcomeTable,
    fit_gap_network,
    gap_network_from_arrays,
    initial_gap_network,
    table_of,
)
from pemviz.sampling.estimates.estimate import importance_sampling_estimate
from pemviz.sampling.estimates.importance_weights import smoothed_weights
from pemviz.sampling.method import (
    VIOLATION_THRESHOLD,
    elite_threshold,
    elites,
    importance_stage_figures,
    network_seed,
    sample_stage,
    stage_seeds,
)
from pemviz.sampling.problem import FinishedStage, Problem, sample_batches
from pemviz.sampling.rollouts.large_stages import (
    LARGEST_PART,
    FinalBatch,
    Thinned,
    Whole,
    largest_held,
    part_sizes,
)
from pemviz.types import Estimate, Proposal, ScoredRollouts, StageKind, StageResult

LOSS = "loss"


@dataclass(frozen=True)
class Learned:
    """What a stage teaches.

    Attributes:
        table: Weighted outcomes.
        threshold: The level of robustness below which they lie; ``None``: all are learned from.
        elites: How many rollouts do.
    """

    table: OutcomeTable
    threshold: float | None
    elites: int


class Lesson(Protocol):
    """What is learned from a stage, as far as it is drawn."""

    def extended(self, batch: ScoredRollouts) -> Self:
        """With the next rollouts."""
        ...

    def learned(self, robustness: FloatArray) -> Learned:
        """What the stage teaches, once all its rollouts ``[N]`` are drawn."""
        ...


@dataclass(frozen=True)
class FromAll:
    """All rollouts are learned from alike, each as soon as it is drawn.

    Attributes:
        weight: Of each.
        sums: Of their outcomes.
    """

    weight: float
    sums: OutcomeSums

    @staticmethod
    def of(count: int) -> "FromAll":
        """Before the first of ``count`` rollouts."""
        weight = float(smoothed_weights(np.zeros(count), alpha=0.0)[0])
        return FromAll(weight, OutcomeSums.of_none())

    def extended(self, batch: ScoredRollouts) -> Self:
        """With the next rollouts."""
        count = batch.rollouts.count
        sums = self.sums.with_rollouts(
            gap_m=_gap_m(batch),
            detected=batch.rollouts.detected,
            rollout_weight=np.full(count, self.weight),
        )
        return replace(self, sums=sums)

    def learned(self, robustness: FloatArray) -> Learned:
        """What the stage teaches, once all its rollouts ``[N]`` are drawn."""
        return Learned(table_of(self.sums), None, robustness.size)


@dataclass(frozen=True)
class Candidate(Batch):
    """Rollouts that may turn out to be elites.

    Attributes:
        robustness: ``[M]``.
        log_weight: ``[M]`` [nats].
        gap_m: At which perception acted, ``[M, T-1]``.
        detected: Its outcomes there, ``[M, T-1]``.
    """

    robustness: FloatArray
    log_weight: FloatArray
    gap_m: FloatArray
    detected: BoolArray


@dataclass(frozen=True)
class FromElites:
    """Elites are learned from; who is one is known once all are drawn.

    A rollout above the level of those drawn so far is none whatever comes.

    Attributes:
        sigma: Elite quantile.
        alpha: Exponent of the weights.
        least: So many rollouts at least are elites.
        held: Candidates, in the order in which they were drawn.
        level: No rollout above it is one.
        settled: How many candidates there were when the level was last lowered.
    """

    sigma: float
    alpha: float
    least: int
    held: tuple[Candidate, ...] = ()
    level: float = np.inf
    settled: int = 0

    @staticmethod
    def of(count: int, *, sigma: float, alpha: float) -> "FromElites":
        """Before the first of ``count`` rollouts."""
        places = np.arange(count, dtype=np.float64)
        least = int(elites(places, threshold=elite_threshold(places, sigma=sigma)).sum())
        return FromElites(sigma=sigma, alpha=alpha, least=least)

    def extended(self, batch: ScoredRollouts) -> Self:
        """With the next rollouts."""
        rollouts = batch.rollouts
        rows = np.flatnonzero(batch.robustness <= self.level)
        some = Candidate(
            robustness=batch.robustness[rows],
            log_weight=rollouts.log_weight[rows],
            gap_m=_gap_m(batch)[rows],
            detected=rollouts.detected[rows],
        )
        grown = replace(self, held=(*self.held, some))
        known = sum(part.robustness.size for part in grown.held)
        return grown if known < max(self.least, 2 * self.settled) else grown._lowered()

    def _lowered(self) -> Self:
        """With the level of those drawn so far, and the candidates at or below it."""
        robustness = np.concatenate([part.robustness for part in self.held])
        level = float(np.partition(robustness, self.least - 1)[self.least - 1])
        level = max(level, VIOLATION_THRESHOLD)
        held = tuple(part.take(part.robustness <= level) for part in self.held)
        left = sum(part.robustness.size for part in held)
        return replace(self, held=held, level=level, settled=left)

    def learned(self, robustness: FloatArray) -> Learned:
        """What the stage teaches, once all its rollouts ``[N]`` are drawn."""
        threshold = elite_threshold(robustness, sigma=self.sigma)
        chosen = [part.take(elites(part.robustness, threshold=threshold)) for part in self.held]
        log_weight = np.concatenate([part.log_weight for part in chosen])
        weight = smoothed_weights(log_weight, alpha=self.alpha)
        sums, parts = OutcomeSums.of_none(), _split(weight, chosen)
        for part, rollout_weight in zip(chosen, parts, strict=True):
            sums = sums.with_rollouts(
                gap_m=part.gap_m, detected=part.detected, rollout_weight=rollout_weight
            )
        return Learned(table_of(sums), threshold, log_weight.size)


def _split(weight: FloatArray, parts: list[Candidate]) -> Iterator[FloatArray]:
    ends = np.cumsum([part.robustness.size for part in parts])
    return iter(np.split(weight, ends[:-1]))


def _gap_m(batch: ScoredRollouts) -> FloatArray:
    return batch.rollouts.decision_states().signals["gap"]


@dataclass(frozen=True)
class AdaptiveState:
    """Where a repetition stands.

    Attributes:
        repetition: Zero-based.
        stage: The stage that ``step`` carries out next.
        network: The proposal learned so far.
        rollouts_simulated: In all stages so far.
        batch: How far the final rollouts are drawn.
    """

    repetition: int
    stage: int
    network: GapNetwork
    batch: FinalBatch
    rollouts_simulated: int = 0


@dataclass(frozen=True)
class _Stage:
    """A stage's rollouts, and what was learned from them; see :class:`StageResult`."""

    scored: ScoredRollouts
    drawn: Drawn | None = None
    network: GapNetwork | None = None
    threshold: float | None = None
    elites: int = 0
    loss: float | None = None
    timings_s: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def kept(self) -> Mapping[str, AnyArray]:
        """What another process needs to go on from here."""
        if self.network is None:
            return {}
        return {**self.network.arrays(), LOSS: np.array(self.loss)}


@dataclass(frozen=True, kw_only=True)
class AdaptiveSampling:
    """Stage 0 pre-trains on the error model, stages 1 to K learn, stage K + 1 estimates.

    A large final batch takes further stages, a part each.

    Attributes:
        learning_stages: K.
        rollouts: In each stage but the last (N_kappa).
        final_rollouts: In the last (N_e).
        sigma: Elite quantile.
        alpha: Exponent that smooths the training weights.
        epochs: Training steps in each fit.
        learning_rate: Adam's step size.
        seed: Root of all randomness.
        largest_part: How many final rollouts are drawn at once.
    """

    learning_stages: int
    rollouts: int
    final_rollouts: int
    sigma: float
    alpha: float
    epochs: int
    learning_rate: float
    seed: int
    largest_part: int = LARGEST_PART
    name: str = "adaptive"

    @property
    def stages(self) -> int:
        """Pre-training, K learning stages and the final one, or its parts."""
        return self.learning_stages + 1 + len(self._final_sizes())

    def init(self, problem: Problem, *, repetition: int) -> AdaptiveState:  # noqa: ARG002
        """An untrained network, before pre-training."""
        seed = network_seed(seed=self.seed, repetition=repetition)
        return AdaptiveState(
            repetition=repetition,
            stage=0,
            network=initial_gap_network(seed=seed),
            batch=FinalBatch(self._final_sizes()),
        )

    def step(self, problem: Problem, state: AdaptiveState) -> tuple[AdaptiveState, StageResult]:
        """Sample from the proposal; learn from the elites unless the stage is the last."""
        kind = self._kind(state.stage)
        stage = self._final(problem, state) if kind == "final" else self._learning(problem, state)
        failures, probability, log10_probability, ess = importance_stage_figures(
            stage.scored, stage.drawn
        )
        result = StageResult(
            repetition=state.repetition,
            stage=state.stage,
            kind=kind,
            scored=stage.scored,
            sampled_from=self._proposal(state),
            learned=stage.network,
            threshold=stage.threshold,
            elites=stage.elites,
            failures=failures,
            probability=probability,
            log10_probability=log10_probability,
            ess=ess,
            loss=stage.loss,
            kept=stage.kept,
            timings_s=stage.timings_s,
            drawn=stage.drawn,
        )
        advanced = replace(
            state,
            stage=state.stage + 1,
            network=stage.network or state.network,
            batch=state.batch.extended(stage.scored) if kind == "final" else state.batch,
            rollouts_simulated=state.rollouts_simulated + result.count,
        )
        return advanced, result

    def under_rule(self, state: AdaptiveState, rule: str) -> AdaptiveState:
        """The same rollouts with the verdict of one rule."""
        return replace(state, batch=state.batch.under_rule(rule))

    def is_done(self, state: AdaptiveState) -> bool:
        """Whether the final rollouts are drawn."""
        return state.batch.is_done

    def estimate(self, state: AdaptiveState) -> Estimate:
        """The estimate from the final rollouts.

        Raises:
            ValueError: They are not drawn yet.
        """
        return importance_sampling_estimate(
            state.batch.weighed(), method=self.name, rollouts_simulated=state.rollouts_simulated
        )

    def _final_sizes(self) -> tuple[int, ...]:
        return part_sizes(self.final_rollouts, largest=self.largest_part)

    def _kind(self, stage: int) -> StageKind:
        if stage == 0:
            return "pretrain"
        return "learn" if stage <= self.learning_stages else "final"

    def _proposal(self, state: AdaptiveState) -> Proposal:
        """What the next stage is drawn from."""
        return PemProposal() if state.stage == 0 else state.network

    def _final(self, problem: Problem, state: AdaptiveState) -> _Stage:
        scored = sample_stage(
            problem,
            proposal=self._proposal(state),
            count=state.batch.next_size,
            seed=self.seed,
            repetition=state.repetition,
            stage=state.stage,
        )
        return _Stage(scored, timings_s=scored.timings_s)

    def _learning(self, problem: Problem, state: AdaptiveState) -> _Stage:
        """A stage that is learned from: a batch at a time, of which all or some rollouts stay."""
        finished = problem.finished(state.repetition, state.stage)
        if finished is not None:
            problem.progress(self.rollouts, self.rollouts)
            return self._restored(state, finished)
        large = problem.thins and self.rollouts > self.largest_part
        lesson, held = self._lesson(state), self._holding(problem, large=large)
        for batch in sample_batches(
            problem,
            proposal=self._proposal(state),
            count=self.rollouts,
            seeds=stage_seeds(seed=self.seed, repetition=state.repetition, stage=state.stage),
        ):
            lesson, held = lesson.extended(batch), held.extended(batch)
        scored, drawn = held.done()
        began = time.perf_counter()
        learned = lesson.learned(scored.robustness if drawn is None else drawn.robustness)
        network, loss = fit_gap_network(
            state.network,
            learned.table,
            epochs=self.epochs,
            learning_rate=self.learning_rate,
            pause=problem.pause,
        )
        fit_s = time.perf_counter() - began
        return _Stage(
            scored,
            drawn,
            network=network,
            threshold=learned.threshold,
            elites=learned.elites,
            loss=loss,
            timings_s={**scored.timings_s, "fit": fit_s},
        )

    def _restored(self, state: AdaptiveState, finished: FinishedStage) -> _Stage:
        """As an interrupted run left it: what it learned is kept beside its rollouts."""
        scored, drawn = finished.scored, finished.drawn
        robustness = scored.robustness if drawn is None else drawn.robustness
        threshold = None if state.stage == 0 else elite_threshold(robustness, sigma=self.sigma)
        chosen = elites(robustness, threshold=np.inf if threshold is None else threshold)
        return _Stage(
            scored,
            drawn,
            network=gap_network_from_arrays(finished.kept),
            threshold=threshold,
            elites=int(chosen.sum()),
            loss=float(finished.kept[LOSS]),
            timings_s={**scored.timings_s, "fit": 0.0},
        )

    def _lesson(self, state: AdaptiveState) -> Lesson:
        if state.stage == 0:
            return FromAll.of(self.rollouts)
        return FromElites.of(self.rollouts, sigma=self.sigma, alpha=self.alpha)

    def _holding(self, problem: Problem, *, large: bool) -> Thinned | Whole:
        if not large:
            return Whole()
        states = problem.simulator.states
        return Thinned(count=self.rollouts, most=largest_held(states=states))
