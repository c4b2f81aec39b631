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
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.gap_network import GapNetwork, gap_network_from_arrays
from pemviz.proposals.gap_network_fit import fit_gap_network, initial_gap_network, pool_outcomes
from pemviz.sampling.elite_threshold import elite_threshold, elites
from pemviz.sampling.estimates.estimate import importance_sampling_estimate
from pemviz.sampling.estimates.importance_weights import smoothed_weights
from pemviz.sampling.method import importance_stage_figures, network_seed, sample_stage
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.final_batch import LARGEST_PART, FinalBatch, part_sizes
from pemviz.types import Estimate, Proposal, ScoredRollouts, StageKind, StageResult

LOSS = "loss"


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
        proposal: Proposal = PemProposal() if kind == "pretrain" else state.network
        scored = sample_stage(
            problem,
            proposal=proposal,
            count=state.batch.next_size if kind == "final" else self.rollouts,
            seed=self.seed,
            repetition=state.repetition,
            stage=state.stage,
        )
        advanced = replace(
            state,
            stage=state.stage + 1,
            rollouts_simulated=state.rollouts_simulated + scored.rollouts.count,
        )
        if kind == "final":
            result = self._result(state, scored, kind, proposal)
            return replace(advanced, batch=state.batch.extended(scored)), result
        threshold, chosen = self._chosen(kind, scored)
        began = time.perf_counter()
        network, loss = self._learn(problem, state, scored, chosen)
        fit_s = time.perf_counter() - began
        result = replace(
            self._result(state, scored, kind, proposal),
            learned=network,
            threshold=threshold,
            elites=int(chosen.sum()),
            loss=loss,
            kept={**network.arrays(), LOSS: np.array(loss)},
            timings_s={**scored.timings_s, "fit": fit_s},
        )
        return replace(advanced, network=network), result

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

    def _chosen(self, kind: StageKind, scored: ScoredRollouts) -> tuple[float | None, BoolArray]:
        """The level and which rollouts are learned from: in pre-training, all."""
        if kind == "pretrain":
            return None, np.ones(scored.rollouts.count, dtype=np.bool_)
        threshold = elite_threshold(scored.robustness, sigma=self.sigma)
        return threshold, elites(scored.robustness, threshold=threshold)

    def _learn(
        self, problem: Problem, state: AdaptiveState, scored: ScoredRollouts, chosen: BoolArray
    ) -> tuple[GapNetwork, float]:
        """The fitted network and its loss, as an interrupted run left them if it did."""
        finished = problem.finished(state.repetition, state.stage)
        if finished is not None:
            return gap_network_from_arrays(finished.kept), float(finished.kept[LOSS])
        return self._fit(problem, state, scored, chosen)

    def _fit(
        self, problem: Problem, state: AdaptiveState, scored: ScoredRollouts, chosen: BoolArray
    ) -> tuple[GapNetwork, float]:
        rollouts = scored.rollouts
        alpha = 0.0 if self._kind(state.stage) == "pretrain" else self.alpha
        weight: FloatArray = smoothed_weights(rollouts.log_weight[chosen], alpha=alpha)
        table = pool_outcomes(
            gap_m=rollouts.decision_states().signals["gap"][chosen],
            detected=rollouts.detected[chosen],
            rollout_weight=weight,
        )
        return fit_gap_network(
            state.network,
            table,
            epochs=self.epochs,
            learning_rate=self.learning_rate,
            pause=problem.pause,
        )

    @staticmethod
    def _result(
        state: AdaptiveState, scored: ScoredRollouts, kind: StageKind, proposal: Proposal
    ) -> StageResult:
        failures, probability, log10_probability, ess = importance_stage_figures(scored)
        return StageResult(
            repetition=state.repetition,
            stage=state.stage,
            kind=kind,
            scored=scored,
            sampled_from=proposal,
            learned=None,
            threshold=None,
            elites=0,
            failures=failures,
            probability=probability,
            log10_probability=log10_probability,
            ess=ess,
            loss=None,
            timings_s=scored.timings_s,
        )
