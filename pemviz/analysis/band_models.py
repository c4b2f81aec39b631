"""Error models that miss with one probability in each band of distance, from one set of rollouts.

A chain of outcomes is as likely under such a model as its misses and hits in each band say. With
m_b misses and h_b hits of a violating rollout in band b, at steps whose outcome may matter, and
its log weight under the model u' that it was sampled for::

    mu(u) = 1 / N sum_i 1[i violates] w_i prod_b (u_b / u'_b)^m_ib ((1 - u_b) / (1 - u'_b))^h_ib

so that violations drawn once serve every model near that one.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pemviz.analysis.causes import failures_of
from pemviz.arrays import BoolArray, FloatArray
from pemviz.pem import PemCard
from pemviz.pem.data.support import BEHIND_M, DISTANCE_EDGES_M, SHAPE, cell_of
from pemviz.pem.models.tabulated import TabulatedPem
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.problem import Problem, nothing_finished
from pemviz.sampling.rollouts.runners import run_here
from pemviz.sampling.rollouts.simulate import replay
from pemviz.types import Estimate, ScoredRollouts

BANDS = SHAPE[-1]
LEARNING_STAGES = 5
LEARNING_ROLLOUTS = 60
FINAL_ROLLOUTS = 200
MOST_CERTAIN = 1e-12
"""Neither misses nor hits are held to be likelier than 1 minus this."""


@dataclass(frozen=True)
class BandOutcomes:
    """Violating rollouts by how often they miss and hit in each of B bands.

    Attributes:
        log_rest: Log weight of each but for the outcomes counted here, ``[V]``.
        misses: At steps whose outcome may matter, ``[V, B]``.
        hits: Likewise.
        rollouts: How many were sampled, N.
        salient: The variables at those steps ``[M, 11]``, of all rollouts one after the other.
    """

    log_rest: FloatArray
    misses: FloatArray
    hits: FloatArray
    rollouts: int
    salient: FloatArray

    def log_likelihoods(self, miss: FloatArray) -> FloatArray:
        """Log weights ``[V]`` under the model with P(missed) ``miss [B]``."""
        share = np.clip(miss, MOST_CERTAIN, 1.0 - MOST_CERTAIN)
        return self.log_rest + self.misses @ np.log(share) + self.hits @ np.log1p(-share)

    def log_probability(self, miss: FloatArray) -> float:
        """Log of the failure probability with P(missed) ``miss [B]``; -inf without violations."""
        if self.log_rest.size == 0:
            return -math.inf
        return log_sum(self.log_likelihoods(miss)) - math.log(self.rollouts)

    def effective_failures(self, miss: FloatArray) -> float:
        """Kish's effective number of violations that carry it."""
        return effective_sample_size(self.log_likelihoods(miss)) if self.log_rest.size else 0.0

    def slopes(self, miss: FloatArray) -> FloatArray:
        """Elasticities ``[B]``: d log(failure probability) / d log(P(missed) in a band)."""
        share = np.clip(miss, MOST_CERTAIN, 1.0 - MOST_CERTAIN)
        weight = self.log_likelihoods(share)
        weight = np.exp(weight - log_sum(weight))
        return weight @ (self.misses - self.hits * share / (1.0 - share))


def band_model(miss: FloatArray, *, name: str = "by band") -> TabulatedPem:
    """The model that misses with probability ``miss [B]`` in each band of distance z."""
    share = np.clip(miss, MOST_CERTAIN, 1.0 - MOST_CERTAIN)
    card = PemCard(
        name=name,
        model="table",
        data="none: one P(missed) for each band of distance",
        licence="none needed",
        recipe="stated",
    )
    lower_edges = np.asarray((BEHIND_M, *DISTANCE_EDGES_M))
    return TabulatedPem(card, lower_edges, np.log1p(-share) - np.log(share), between="step")


def rollouts_under(
    problem: Problem, *, features: StateFeatures, seed: int
) -> tuple[Estimate, ScoredRollouts, FloatArray]:
    """A small run of method ``mixture``.

    Returns:
        The estimate, all rollouts, and their log weights ``[N]``.
    """
    here = replace(problem, run_batches=run_here, finished=nothing_finished)
    method = MixtureSampling(
        learning_stages=LEARNING_STAGES,
        rollouts=LEARNING_ROLLOUTS,
        final_rollouts=FINAL_ROLLOUTS,
        seed=seed,
        features=features,
    )
    state = method.init(here, repetition=0)
    sampled: list[ScoredRollouts] = []
    while not method.is_done(state):
        state, stage = method.step(here, state)
        sampled.append(stage.scored)
    scored = ScoredRollouts.concatenate([replace(part, timings_s={}) for part in sampled])
    return method.estimate(state), scored, method.pooled_log_weight(state)


def visited_salient(problem: Problem) -> FloatArray:
    """Variables ``[2, T, 11]`` of the states with all outcomes missed, and with all detected."""
    outcomes = np.zeros((2, problem.simulator.states - 1), dtype=np.bool_)
    outcomes[1] = True
    return problem.simulator.salient(replay(simulator=problem.simulator, detected=outcomes))


def band_outcomes(
    problem: Problem, *, miss: FloatArray, features: StateFeatures, seed: int
) -> BandOutcomes:
    """Violations drawn for the model with P(missed) ``miss [B]``; see :func:`rollouts_under`."""
    model = band_model(miss)
    _, scored, log_weight = rollouts_under(
        replace(problem, pem=model), features=features, seed=seed
    )
    failures = failures_of(scored, features=features)
    if failures is None:
        nothing = np.empty((0, BANDS))
        return BandOutcomes(np.empty(0), nothing, nothing, scored.rollouts.count, np.empty((0, 11)))
    salient = problem.simulator.salient(failures.rollouts.decision_states().signals)
    band = cell_of(salient)[-1].reshape(failures.deciding.shape)

    def counted(chosen: BoolArray) -> FloatArray:
        each = [np.count_nonzero(chosen & (band == index), axis=1) for index in range(BANDS)]
        return np.stack(each, axis=1).astype(np.float64)

    misses = counted(failures.missed)
    hits = counted(failures.deciding & failures.rollouts.detected)
    share = np.clip(miss, MOST_CERTAIN, 1.0 - MOST_CERTAIN)
    own = misses @ np.log(share) + hits @ np.log1p(-share)
    return BandOutcomes(
        log_rest=log_weight[np.flatnonzero(scored.violated)] - own,
        misses=misses,
        hits=hits,
        rollouts=scored.rollouts.count,
        salient=salient[failures.deciding],
    )
