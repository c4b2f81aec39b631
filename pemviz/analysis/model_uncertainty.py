"""What a result owes to its perception error model: other models, and thin training data."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.analysis.band_models import rollouts_under
from pemviz.arrays import BoolArray, FloatArray, row_sums
from pemviz.config.ranges import AtLeastZero, Confidence, Count, Log10, Share
from pemviz.pem import (
    Pem,
    PemEnsemble,
    data_bound_pem,
    pem_interval,
    reweight,
    support_check,
    support_of,
)
from pemviz.pem.judging.reweight import MemberEstimates
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.estimates.estimate import CONFIDENCE, monte_carlo_estimate
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.estimates.meanings import SMALL_ESS
from pemviz.sampling.problem import Problem, sample_batches
from pemviz.sampling.rollouts.draw import replay
from pemviz.sampling.rollouts.final_batch import WeighedRollouts, weighed
from pemviz.sampling.state.composed import (
    memory_of_pem,
    own_pem,
    own_salient,
)
from pemviz.types import ScoredRollouts, Simulator

DATA_BOUND_ROLLOUTS = 10_000
FRAIL_DATA_BOUND_ROLLOUTS = 2_000
"""Where obstacles differ: a rollout then takes ten times as long."""
ENOUGH_FAILURES = 2_000
"""Of which the models' own answers are formed; the models differ by far more than 1/sqrt of it."""
SHOWN_ROLLOUTS = 5_000
"""Of which it is asked whether they go where the training data never was."""
DATA_BOUND_KEY = 2**32 - 2
FEW_FAILURES = 100


@dataclass(frozen=True)
class ModelInterval:
    """The failure probability over models that the training data could as well have produced.

    Attributes:
        low: Lower end; ``None`` where no rollout violates under some model.
        high: Upper end; ``None`` where no rollout violates at all.
        median: Over the models.
        members: How many models.
        confidence: Share of them inside.
        warnings: What limits the interval.
        log10_answers: The decimal logarithm of the failure probability under each model, lowest
            first; ``None`` where no rollout violates under it. Empty in results of versions that
            did not keep them.
    """

    low: AtLeastZero | None
    high: AtLeastZero | None
    median: AtLeastZero | None
    members: Count
    confidence: Confidence
    warnings: tuple[str, ...]
    log10_answers: tuple[Log10 | None, ...] = ()


def member_estimates(
    scored: ScoredRollouts, *, simulator: Simulator, ensemble: PemEnsemble
) -> MemberEstimates:
    """The failure probability under each of the ensemble's models, from the same rollouts.

    Of many rollouts the first are enough: as many as hold ENOUGH_FAILURES violations.
    """
    count = _enough(scored.violated)
    rollouts, violated = scored.rollouts.take(slice(count)), scored.violated[:count]
    failing = rollouts.take(violated)
    log_q = failing.log_q
    if failing.latents is not None:  # all members agree on them: what is left is their weight
        log_q = row_sums(log_q) - failing.latents.log_weight
    return reweight(
        detected=failing.detected,
        salient=simulator.salient(failing.decision_states().signals),
        log_q=log_q,
        violated=violated[violated],
        members=ensemble.members,
        rollouts=rollouts.count,
    )


def _enough(violated: BoolArray) -> int:
    """How many rollouts hold ENOUGH_FAILURES violations, if violations come evenly."""
    share = ENOUGH_FAILURES / max(int(violated.sum()), 1)
    return violated.size if share >= 1.0 else math.ceil(share * violated.size)


def model_interval(repetitions: Sequence[MemberEstimates]) -> ModelInterval:
    """Pool repetitions of equal size into one interval over the models."""
    log_mu = np.stack([estimates.log_mu for estimates in repetitions])
    pooled = MemberEstimates(
        names=repetitions[0].names,
        log_mu=np.array([_log_mean(column) for column in log_mu.T]),
        relative_std_error=repetitions[0].relative_std_error,
        effective_failures=np.sum([e.effective_failures for e in repetitions], axis=0),
    )
    interval = pem_interval(pooled, few_effective=SMALL_ESS)
    return ModelInterval(
        low=_power(interval.log10_low),
        high=_power(interval.log10_high),
        median=_power(interval.log10_median),
        members=interval.members,
        confidence=interval.confidence,
        warnings=interval.warnings,
        log10_answers=tuple(
            value if math.isfinite(value) else None
            for value in sorted((pooled.log_mu / math.log(10.0)).tolist())
        ),
    )


@dataclass(frozen=True)
class DataBound:
    """What the training data alone allow, without the model's own guesses.

    Attributes:
        probability: The failure probability is below this with ``confidence``, if P(missed) is
            constant within distance bands and misses never help.
        rollouts: Rollouts that it rests on.
        failures: Those that violate.
        confidence: Of the bands' bounds together, and again of the rollouts' upper bound.
    """

    probability: Share
    rollouts: Count
    failures: Count
    confidence: Confidence


def data_bound(
    problem: Problem, *, seed: int, sharpened_by: StateFeatures | None = None
) -> DataBound | None:
    """Bound the failure probability by the training data's counts alone.

    The exact (Clopper-Pearson) upper bound of P(missed) in each distance band, and certain
    misses where there is no data, make a model of their own; plain Monte Carlo carries it to
    the failure probability. ``None`` for a model without counts.

    Args:
        problem: On a fast simulator.
        seed: Root of all randomness.
        sharpened_by: With these features, where plain Monte Carlo sees few violations, importance
            sampling (method ``mixture``) has its say as well, unless something speaks against it.
    """
    support = support_of(own_pem(problem.pem))
    if support is None:
        return None
    simulator = problem.simulator
    outcomes = np.zeros((2, simulator.states - 1), dtype=np.bool_)
    outcomes[1] = True
    visited = simulator.salient(replay(simulator=simulator, detected=outcomes))
    visited = own_salient(problem.pem, visited)
    is_frail = memory_of_pem(problem.pem).frailty > 0.0
    bound = data_bound_pem(visited, support=support, confidence=CONFIDENCE)
    batches = sample_batches(
        problem.under(bound),
        proposal=PemProposal(),
        count=FRAIL_DATA_BOUND_ROLLOUTS if is_frail else DATA_BOUND_ROLLOUTS,
        seeds=np.random.SeedSequence(seed, spawn_key=(DATA_BOUND_KEY,)),
    )
    drawn = WeighedRollouts.concatenate([weighed(batch) for batch in batches])
    allowed = monte_carlo_estimate(drawn, method="monte-carlo")
    if sharpened_by is not None and allowed.failures < FEW_FAILURES:
        sharp, *_ = rollouts_under(problem.under(bound), features=sharpened_by, seed=seed)
        if sharp.failures and sharp.ci_high is not None and not sharp.diagnostics:
            allowed = sharp
    return DataBound(
        probability=1.0 if allowed.ci_high is None else allowed.ci_high,
        rollouts=allowed.rollouts_simulated,
        failures=allowed.failures,
        confidence=CONFIDENCE,
    )


def extrapolation_warnings(
    scored: ScoredRollouts, *, simulator: Simulator, pem: Pem
) -> tuple[str, ...]:
    """Where the rollouts ask the model about what its training data never showed.

    Models that carry no counts of their training data are met with one warning that says so.
    """
    own = own_pem(pem)
    support = support_of(own)
    if support is None:
        return (
            f"error model {pem.name}: carries no counts of its training data, so where it "
            "extrapolates cannot be told",
        )
    checked = scored.rollouts.take(slice(SHOWN_ROLLOUTS))
    salient = simulator.salient(checked.decision_states().signals)
    salient = own_salient(pem, salient)
    return support_check(salient, support=support, pem=own).warnings


def _log_mean(log_values: FloatArray) -> float:
    finite = log_values[np.isfinite(log_values)]
    return log_sum(finite) - math.log(log_values.size) if finite.size else -math.inf


def _power(log10_value: float) -> float | None:
    return 10.0**log10_value if math.isfinite(log10_value) else None
