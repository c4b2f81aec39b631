"""What a result owes to its perception error model: other models, and thin training data."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.pem import Pem, PemEnsemble, pem_interval, reweight, support_check, support_of
from pemviz.pem.reweight import MemberEstimates
from pemviz.sampling.weights import log_sum
from pemviz.types import ScoredRollouts, Simulator


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
    """

    low: float | None
    high: float | None
    median: float | None
    members: int
    confidence: float
    warnings: tuple[str, ...]


def member_estimates(
    scored: ScoredRollouts, *, simulator: Simulator, ensemble: PemEnsemble
) -> MemberEstimates:
    """The failure probability under each of the ensemble's models, from the same rollouts."""
    rollouts, violated = scored.rollouts, scored.violated
    failures = int(violated.sum())
    states = rollouts.decision_states()
    failing = {name: values[violated] for name, values in states.signals.items()}
    estimates = reweight(
        detected=rollouts.detected[violated],
        salient=simulator.salient(failing),
        log_q=rollouts.log_q[violated],
        violated=np.ones(failures, dtype=np.bool_),
        members=ensemble.members,
    )
    # the average over the failing rollouts, spread over all of them
    share = math.log(failures / rollouts.count) if failures else 0.0
    return MemberEstimates(
        names=estimates.names,
        log_mu=estimates.log_mu + share,
        relative_std_error=estimates.relative_std_error,
        effective_failures=estimates.effective_failures,
    )


def model_interval(repetitions: Sequence[MemberEstimates]) -> ModelInterval:
    """Pool repetitions of equal size into one interval over the models."""
    log_mu = np.stack([estimates.log_mu for estimates in repetitions])
    pooled = MemberEstimates(
        names=repetitions[0].names,
        log_mu=np.array([_log_mean(column) for column in log_mu.T]),
        relative_std_error=repetitions[0].relative_std_error,
        effective_failures=np.sum([e.effective_failures for e in repetitions], axis=0),
    )
    interval = pem_interval(pooled)
    return ModelInterval(
        low=_power(interval.log10_low),
        high=_power(interval.log10_high),
        median=_power(interval.log10_median),
        members=interval.members,
        confidence=interval.confidence,
        warnings=interval.warnings,
    )


def extrapolation_warnings(
    scored: ScoredRollouts, *, simulator: Simulator, pem: Pem
) -> tuple[str, ...]:
    """Where the rollouts ask the model about what its training data never showed.

    Models that carry no counts of their training data are met with one warning that says so.
    """
    support = support_of(pem)
    if support is None:
        return (
            f"error model {pem.name}: carries no counts of its training data, so where it "
            "extrapolates cannot be told",
        )
    salient = simulator.salient(scored.rollouts.decision_states().signals)
    return support_check(salient, support=support, pem=pem).warnings


def _log_mean(log_values: FloatArray) -> float:
    finite = log_values[np.isfinite(log_values)]
    return log_sum(finite) - math.log(log_values.size) if finite.size else -math.inf


def _power(log10_value: float) -> float | None:
    return 10.0**log10_value if math.isfinite(log10_value) else None
