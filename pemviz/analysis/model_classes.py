"""Other classes of error models that the same data produced, asked with the same rollouts.

A model's refits differ by chance; another model class (logistic regression, trees, a Bayesian net)
extends elsewhere to where there are no data, and nobody's labels say which is right. The
simulator's answer to a chain of detections does not depend on the model, so rollouts with their
weights under one model give the failure probability under another::

    mu_f = 1 / N sum_i 1[i violates] w_i p_f(i) / p(i)

with w_i the weight p(i) / q(i) that carries the estimate itself.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import Batch, FloatArray, IntArray, row_sums
from pemviz.config.ranges import AtLeastZero, Log10
from pemviz.errors import PemError
from pemviz.pem import Pem, load_pem, shipped_pems
from pemviz.pem.models.pieces import chain_logit_along
from pemviz.pem.models.protocol import chain_log_likelihood
from pemviz.sampling.estimates.importance_weights import effective_sample_size, log_sum
from pemviz.sampling.estimates.meanings import SMALL_ESS
from pemviz.types import RolloutBatch, ScoredRollouts, Simulator

MOST_VIOLATIONS = 2_000
"""Of a stage: model classes differ by far more than 1 / sqrt of it."""


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
    others: list[Pem] = []
    for name in shipped_pems():
        try:
            model = load_pem(name)
        except PemError:  # a damaged file is told where that model is asked for
            continue
        if model.data == pem.data and model.name != pem.name and not name.endswith("-ensemble"):
            others.append(model)
    return tuple(others)


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
    """Violations with their rollouts, as model classes are asked of them.

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
    return Violating(
        rollout=violations,
        rollouts=scored.rollouts.take(violations),
        log_stands_for=np.full(
            violations.size, math.log(count / violations.size) if count else 0.0
        ),
    )


def model_class_ratios(
    asked: Violating, *, simulator: Simulator, model_classes: Sequence[Pem]
) -> ModelClassRatios:
    """What ``model_classes`` make of violations.

    Of several stages together sooner than one by one: what it takes to ask a model along the gap
    hardly grows with the number of rollouts.

    Args:
        asked: The violations.
        simulator: That they come from.
        model_classes: F models.
    """
    if asked.rollout.size == 0:
        empty = np.empty((0, len(model_classes)))
        return ModelClassRatios(asked.rollout, asked.log_stands_for, empty)
    failing = asked.rollouts
    salient = simulator.salient(failing.decision_states().signals)
    log_p = row_sums(failing.log_p)
    columns = [
        chain_log_likelihood(model, salient, failing.detected, logit_of=chain_logit_along) - log_p
        for model in model_classes
    ]
    return ModelClassRatios(
        rollout=asked.rollout,
        log_stands_for=asked.log_stands_for,
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
