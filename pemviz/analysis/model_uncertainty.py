"""What a result owes to its error model: refits, other model classes, and thin training data.

A model's refits differ by chance; another model class (logistic regression, trees, a Bayesian net)
extends elsewhere to where there are no data, and nobody's labels say which is right. The
simulator's answer to a chain of detections does not depend on the model, so rollouts with their
weights under one model give the failure probability under another::

    mu_f = 1 / N sum_i 1[i violates] w_i p_f(i) / p(i)

with w_i the weight p(i) / q(i) that carries the estimate itself.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from pemviz.analysis.band_models import rollouts_under, visited_salient
from pemviz.arrays import Batch, FloatArray, IntArray, row_sums
from pemviz.config.ranges import AtLeastZero, Confidence, Count, Log10, Share
from pemviz.errors import PemError
from pemviz.pem import (
    Pem,
    PemEnsemble,
    data_bound_pem,
    load_pem,
    pem_interval,
    reweight,
    shipped_pems,
    support_check,
    support_of,
)
from pemviz.pem.data.support import closing_warnings
from pemviz.pem.judging.reweight import MemberEstimates
from pemviz.pem.models.cards import PemCard, fitted_memory
from pemviz.pem.models.pieces import chain_logit_along
from pemviz.pem.models.protocol import chain_log_likelihood
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.estimates.estimators import CONFIDENCE, monte_carlo_estimate
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size
from pemviz.sampling.problem import Problem, sample_batches
from pemviz.sampling.rollouts.large_stages import WeighedRollouts, weighed
from pemviz.sampling.slots import turns_of
from pemviz.sampling.state.composed import hidden_in, memory_of_pem, own_pem, own_salient
from pemviz.simulators.detector_loop import DetectorItself
from pemviz.types import RolloutBatch, ScoredRollouts, Simulator

MOST_VIOLATIONS = 2_000
"""Of a stage: model classes differ by far more than 1 / sqrt of it."""
DATA_BOUND_ROLLOUTS = 10_000
FRAIL_DATA_BOUND_ROLLOUTS = 2_000
"""Where obstacles differ: a rollout then takes ten times as long."""
ENOUGH_FAILURES = 2_000
"""Of which the models' own answers are formed; the models differ by far more than 1/sqrt of it."""
MOST_FAILURES = 4 * ENOUGH_FAILURES
"""Of any rule, where one is broken more rarely than the others."""
SHOWN_ROLLOUTS = 5_000
"""Of which it is checked whether they go where the training data never was."""
DATA_BOUND_KEY = 2**32 - 2
FEW_FAILURES = 100


@dataclass(frozen=True)
class ModelClassAnswer:
    """The failure probability under another model class.

    Attributes:
        name: The model's.
        probability: 0 where ``log10_probability`` is too small for a double.
        log10_probability: Its decimal logarithm.
        relative_std_error: Standard error over the probability.
        effective_failures: Kish's effective number of violating rollouts that carry it.
    """

    name: str
    probability: AtLeastZero
    log10_probability: Log10
    relative_std_error: AtLeastZero
    effective_failures: AtLeastZero

    @property
    def is_reliable(self) -> bool:
        """Whether enough rollouts carry it."""
        return self.effective_failures >= SMALL_ESS


def model_classes_beside(pem: Pem) -> tuple[Pem, ...]:
    """The shipped single models that were trained on the same data as ``pem``, but ``pem``."""
    return tuple(
        model for model in _shipped_singles() if model.data == pem.data and model.name != pem.name
    )


@cache
def _shipped_singles() -> tuple[Pem, ...]:
    """Read once: every run looks at all of them, and nobody is handed one to change."""
    models: list[Pem] = []
    for name in shipped_pems():
        if name.endswith("-ensemble"):
            continue
        # a damaged file is reported where that model is wanted
        with contextlib.suppress(PemError):
            models.append(load_pem(name))
    return tuple(models)


@dataclass(frozen=True)
class SomeViolations(Batch):
    """Some of the violations of N rollouts.

    Attributes:
        rollout: Index of each, ``[V]``.
        log_stands_for: Log of how many violations each stands for, ``[V]``.
    """

    rollout: IntArray
    log_stands_for: FloatArray


@dataclass(frozen=True)
class Violating(SomeViolations):
    """Violations with their rollouts, as model classes re-weight them.

    Attributes:
        rollouts: ``[V]``.
    """

    rollouts: RolloutBatch


@dataclass(frozen=True)
class ModelClassRatios(SomeViolations):
    """Violations with what F other model classes make of them.

    Attributes:
        log_ratio: Log p_f / p of each under each model class, ``[V, F]``.
    """

    log_ratio: FloatArray


def violating(scored: ScoredRollouts) -> Violating:
    """A stage's violations, of many an evenly spaced part."""
    violations = np.flatnonzero(scored.violated)
    count = violations.size
    if count > MOST_VIOLATIONS:
        violations = violations[np.arange(MOST_VIOLATIONS) * count // MOST_VIOLATIONS]
    stands_for = math.log(count / violations.size) if count else 0.0
    return Violating(
        rollout=violations,
        rollouts=scored.rollouts.take(violations),
        log_stands_for=np.full(violations.size, stands_for),
    )


def model_class_ratios(
    violations: Violating, *, simulator: Simulator, model_classes: Sequence[Pem]
) -> ModelClassRatios:
    """What ``model_classes`` make of violations.

    Of several stages together: what it takes to evaluate a model along the gap
    hardly grows with the number of rollouts.

    Args:
        violations: To be re-weighted.
        simulator: That they come from.
        model_classes: F models.
    """
    if violations.rollout.size == 0:
        empty = np.empty((0, len(model_classes)))
        return ModelClassRatios(violations.rollout, violations.log_stands_for, empty)
    failing = violations.rollouts
    salient = simulator.salient(failing.decision_states().signals)
    log_p = row_sums(failing.log_p)
    columns = [
        chain_log_likelihood(model, salient, failing.detected, logit_of=chain_logit_along) - log_p
        for model in model_classes
    ]
    return ModelClassRatios(
        rollout=violations.rollout,
        log_stands_for=violations.log_stands_for,
        log_ratio=np.stack(columns, axis=1),
    )


def model_class_answers(
    ratios: ModelClassRatios, *, model_classes: Sequence[Pem], log_weight: FloatArray, of: int
) -> tuple[ModelClassAnswer, ...]:
    """The failure probability under each model class, if any violation speaks for it.

    Args:
        ratios: Of all rollouts that the estimate averages.
        model_classes: F models.
        log_weight: Their violations' log weights under the model itself, ``[V]``.
        of: How many rollouts there are, N.
    """
    carried = log_weight + ratios.log_stands_for
    answers: list[ModelClassAnswer] = []
    for model, log_ratio in zip(model_classes, ratios.log_ratio.T, strict=True):
        log_mu = log_mean(carried + log_ratio, of=of)
        if not math.isfinite(log_mu):
            continue
        second = log_mean(2.0 * (carried + log_ratio), of=of)
        variance = max(math.expm1(second - 2.0 * log_mu), 0.0)
        answers.append(
            ModelClassAnswer(
                name=model.name,
                probability=math.exp(log_mu),
                log10_probability=log_mu / math.log(10.0),
                relative_std_error=math.sqrt(variance / of),
                effective_failures=effective_sample_size(carried + log_ratio),
            )
        )
    return tuple(answers)


def log_mean(log_values: FloatArray, *, of: int) -> float:
    """Log of the sum of exp of values ``[V]`` divided by ``of``; -inf of none."""
    return log_sum(log_values) - math.log(of) if log_values.size else -math.inf


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

    Of many rollouts the first are enough: as many as hold ENOUGH_FAILURES violations of each rule,
    but no more than MOST_FAILURES of any.
    """
    violations = int(scored.violated.sum())
    rarest = min(map(np.count_nonzero, scored.broken.values()), default=violations)
    enough = ENOUGH_FAILURES / max(rarest, 1)
    if violations:
        enough = min(enough, MOST_FAILURES / violations)
    # as many as hold so many violations, if these come evenly
    count = math.ceil(min(enough, 1.0) * scored.violated.size)
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
        broken={name: some[:count][violated] for name, some in scored.broken.items()},
    )


def model_interval(repetitions: Sequence[MemberEstimates]) -> ModelInterval:
    """Pool repetitions of equal size into one interval over the models."""
    log_mu = np.stack([estimates.log_mu for estimates in repetitions])
    pooled = MemberEstimates(
        names=repetitions[0].names,
        log_mu=np.array(
            [log_mean(column[np.isfinite(column)], of=column.size) for column in log_mu.T]
        ),
        relative_std_error=repetitions[0].relative_std_error,
        effective_failures=np.sum([e.effective_failures for e in repetitions], axis=0),
    )
    interval = pem_interval(pooled, few_effective=SMALL_ESS)
    low, high, median = (
        10.0**value if math.isfinite(value) else None
        for value in (interval.log10_low, interval.log10_high, interval.log10_median)
    )
    return ModelInterval(
        low=low,
        high=high,
        median=median,
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
    visited = own_salient(problem.pem, visited_salient(problem))
    is_frail = memory_of_pem(problem.pem).frailty > 0.0
    bound = data_bound_pem(visited, support=support, confidence=CONFIDENCE)
    batches = sample_batches(
        problem.under(bound),
        proposal=PemProposal(),
        count=FRAIL_DATA_BOUND_ROLLOUTS if is_frail else DATA_BOUND_ROLLOUTS,
        seeds=np.random.SeedSequence(seed, spawn_key=(DATA_BOUND_KEY,)),
    )
    sampled = WeighedRollouts.concatenate([weighed(batch) for batch in batches])
    allowed = monte_carlo_estimate(sampled, method="monte-carlo")
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
    if isinstance(own, DetectorItself):
        return ()
    support = support_of(own)
    if support is None:
        return (
            f"error model {pem.name}: carries no counts of its training data, so where it "
            "extrapolates is not known",
        )
    checked = scored.rollouts.take(slice(SHOWN_ROLLOUTS))
    salient = simulator.salient(checked.decision_states().signals)
    salient = own_salient(pem, salient)
    found = support_check(salient, support=support, pem=own).warnings
    card = getattr(own, "card", None)
    if not hidden_in(pem) or not isinstance(card, PemCard) or turns_of(simulator) > 1:
        return found
    violating = salient[scored.violated[:SHOWN_ROLLOUTS]]
    memory = fitted_memory(card.memory, where=pem.name)
    return (*found, *closing_warnings(violating, dt_s=simulator.dt_s, memory=memory))
