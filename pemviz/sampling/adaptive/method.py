"""State-dependent adaptive importance sampling: the paper's Algorithm 1.

Innes & Ramamoorthy, arXiv 2209.09674; a cross-entropy method (de Boer, Kroese, Mannor, Rubinstein
2005) whose proposal sees the state. With p the perception error model, q_phi the proposal, o_t the
outcome at state s_t and r_i the robustness of rollout i::

    weight     w_i     = prod_t p(o_t | s_t) / q_phi(o_t | s_t)
    threshold  gamma_k = max(0, lower 1 - sigma quantile of r_1 .. r_N)
    learning   phi_k   = argmin_phi - sum_{i: r_i <= gamma_k} w_i^alpha sum_t log q_phi(o_t | s_t)
    estimate   mu      = 1 / N_e sum_i 1[i violates] w_i

Stage 0 draws from p and learns from all its rollouts equally (alpha 0, no threshold). The training
weights are divided by their sum; the estimate is of the final rollouts alone.
"""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import Batch, BoolArray, FloatArray
from pemviz.proposals import gap_network
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.gap_network import GapNetwork, OutcomeTable
from pemviz.sampling.estimates.estimators import importance_sampling_estimate
from pemviz.sampling.estimates.importance_weights import smoothed_weights
from pemviz.sampling.method import (
    VIOLATION_THRESHOLD,
    elite_threshold,
    elites,
    final_stage,
    sample_stage,
)
from pemviz.sampling.problem import FinishedStage, Problem, sample_batches
from pemviz.sampling.rollouts import large_stages
from pemviz.sampling.rollouts.large_stages import LARGEST_PART, FinalBatch, Thinned, Whole
from pemviz.sampling.seeds import network_seed, stage_seeds
from pemviz.types import Estimate, Proposal, ScoredRollouts, StageResult

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


@dataclass(frozen=True)
class FromAll:
    """All rollouts are learned from equally, each as soon as it is sampled.

    Attributes:
        weight: Of each, in (0, 1].
        table: Of those sampled so far.
    """

    weight: float
    table: OutcomeTable = field(default_factory=OutcomeTable)

    @staticmethod
    def of(count: int) -> "FromAll":
        """Before the first of ``count`` rollouts."""
        return FromAll(float(smoothed_weights(np.zeros(count), alpha=0.0)[0]))

    def extended(self, batch: ScoredRollouts) -> "FromAll":
        """With the next rollouts."""
        table = self.table.with_rollouts(
            gap_m=_gap_m(batch),
            detected=batch.rollouts.detected,
            rollout_weight=np.full(batch.rollouts.count, self.weight),
        )
        return replace(self, table=table)

    def learned(self, robustness: FloatArray) -> Learned:
        """What the stage teaches, once all its rollouts ``[N]`` are sampled."""
        return Learned(self.table, None, robustness.size)


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
    """Elites are learned from; which these are is known once all rollouts are sampled.

    A rollout above the level of those sampled so far is none whatever comes.

    Attributes:
        sigma: Elite quantile.
        alpha: Exponent of the weights.
        least: So many rollouts at least are elites.
        held: Candidates, in the order in which they were sampled.
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

    def extended(self, batch: ScoredRollouts) -> "FromElites":
        """With the next rollouts; the level falls each time that candidates have doubled."""
        rows = np.flatnonzero(batch.robustness <= self.level)
        some = Candidate(
            robustness=batch.robustness[rows],
            log_weight=batch.rollouts.log_weight[rows],
            gap_m=_gap_m(batch)[rows],
            detected=batch.rollouts.detected[rows],
        )
        held = (*self.held, some)
        robustness = np.concatenate([part.robustness for part in held])
        if robustness.size < max(self.least, 2 * self.settled):
            return replace(self, held=held)
        level = float(np.partition(robustness, self.least - 1)[self.least - 1])
        level = max(level, VIOLATION_THRESHOLD)
        held = tuple(part.take(part.robustness <= level) for part in held)
        left = sum(part.robustness.size for part in held)
        return replace(self, held=held, level=level, settled=left)

    def learned(self, robustness: FloatArray) -> Learned:
        """What the stage teaches, once all its rollouts ``[N]`` are sampled."""
        threshold = elite_threshold(robustness, sigma=self.sigma)
        chosen = [part.take(elites(part.robustness, threshold=threshold)) for part in self.held]
        log_weight = np.concatenate([part.log_weight for part in chosen])
        weight = smoothed_weights(log_weight, alpha=self.alpha)
        ends = np.cumsum([part.robustness.size for part in chosen])
        table = OutcomeTable()
        for part, rollout_weight in zip(chosen, np.split(weight, ends[:-1]), strict=True):
            table = table.with_rollouts(
                gap_m=part.gap_m, detected=part.detected, rollout_weight=rollout_weight
            )
        return Learned(table, threshold, log_weight.size)


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
        batch: How far the final rollouts are sampled.
    """

    repetition: int
    stage: int
    network: GapNetwork
    batch: FinalBatch
    rollouts_simulated: int = 0


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
        largest_part: How many final rollouts are sampled at once.
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
            network=gap_network.initial_gap_network(seed=seed),
            batch=FinalBatch(self._final_sizes()),
        )

    def step(self, problem: Problem, state: AdaptiveState) -> tuple[AdaptiveState, StageResult]:
        """Sample from the proposal; learn from the elites unless the stage is the last."""
        network, batch = state.network, state.batch
        proposal = PemProposal() if state.stage == 0 else network
        if state.stage <= self.learning_stages:
            network, result = self._learning(problem, state, proposal)
        else:
            scored = sample_stage(
                problem,
                proposal=proposal,
                count=batch.next_size,
                seed=self.seed,
                repetition=state.repetition,
                stage=state.stage,
            )
            batch = batch.extended(scored)
            result = final_stage(
                repetition=state.repetition,
                stage=state.stage,
                scored=scored,
                sampled_from=proposal,
            )
        advanced = replace(
            state,
            stage=state.stage + 1,
            network=network,
            batch=batch,
            rollouts_simulated=state.rollouts_simulated + result.count,
        )
        return advanced, result

    def under_rule(self, state: AdaptiveState, rule: str) -> AdaptiveState:
        """The same rollouts with the verdict of one rule."""
        return replace(state, batch=state.batch.under_rule(rule))

    def is_done(self, state: AdaptiveState) -> bool:
        """Whether the final rollouts are sampled."""
        return state.batch.is_done

    def estimate(self, state: AdaptiveState) -> Estimate:
        """The estimate from the final rollouts.

        Raises:
            ValueError: They are not sampled yet.
        """
        return importance_sampling_estimate(
            state.batch.weighed(), method=self.name, rollouts_simulated=state.rollouts_simulated
        )

    def _final_sizes(self) -> tuple[int, ...]:
        return large_stages.part_sizes(self.final_rollouts, largest=self.largest_part)

    def _learning(
        self, problem: Problem, state: AdaptiveState, proposal: Proposal
    ) -> tuple[GapNetwork, StageResult]:
        """A stage that is learned from: a batch at a time, of which all or some rollouts stay."""
        finished = problem.finished(state.repetition, state.stage)
        if finished is not None:
            problem.progress(self.rollouts, self.rollouts)
            return self._restored(state, proposal, finished)
        lesson: FromAll | FromElites = FromAll.of(self.rollouts)
        if state.stage > 0:
            lesson = FromElites.of(self.rollouts, sigma=self.sigma, alpha=self.alpha)
        held: Thinned | Whole = Whole()
        if problem.thins and self.rollouts > self.largest_part:
            most = large_stages.largest_held(states=problem.simulator.states)
            held = Thinned(count=self.rollouts, most=most)
        for batch in sample_batches(
            problem,
            proposal=proposal,
            count=self.rollouts,
            seeds=stage_seeds(seed=self.seed, repetition=state.repetition, stage=state.stage),
        ):
            lesson, held = lesson.extended(batch), held.extended(batch)
        scored, sampled = held.done()
        began = time.perf_counter()
        learned = lesson.learned(scored.robustness if sampled is None else sampled.robustness)
        network, loss = gap_network.fit_gap_network(
            state.network,
            learned.table,
            epochs=self.epochs,
            learning_rate=self.learning_rate,
            pause=problem.pause,
        )
        result = final_stage(
            repetition=state.repetition,
            stage=state.stage,
            scored=scored,
            sampled_from=proposal,
            sampled=sampled,
        )
        return network, _taught(
            result,
            network,
            threshold=learned.threshold,
            elites=learned.elites,
            loss=loss,
            fit_s=time.perf_counter() - began,
        )

    def _restored(
        self, state: AdaptiveState, proposal: Proposal, finished: FinishedStage
    ) -> tuple[GapNetwork, StageResult]:
        """As an interrupted run left it: what it learned is kept beside its rollouts."""
        scored, sampled = finished.scored, finished.sampled
        robustness = scored.robustness if sampled is None else sampled.robustness
        threshold = None if state.stage == 0 else elite_threshold(robustness, sigma=self.sigma)
        chosen = elites(robustness, threshold=np.inf if threshold is None else threshold)
        network = gap_network.gap_network_from_arrays(finished.kept)
        result = final_stage(
            repetition=state.repetition,
            stage=state.stage,
            scored=scored,
            sampled_from=proposal,
            sampled=sampled,
        )
        return network, _taught(
            result,
            network,
            threshold=threshold,
            elites=int(chosen.sum()),
            loss=float(finished.kept[LOSS]),
            fit_s=0.0,
        )


def _taught(
    result: StageResult,
    network: GapNetwork,
    *,
    threshold: float | None,
    elites: int,
    loss: float,
    fit_s: float,
) -> StageResult:
    """The record of a stage with what was learned, and what another process needs to go on."""
    return replace(
        result,
        kind="pretrain" if result.stage == 0 else "learn",
        learned=network,
        threshold=threshold,
        elites=elites,
        loss=loss,
        kept={**network.arrays(), LOSS: np.array(loss)},
        timings_s={**result.timings_s, "fit": fit_s},
    )
