"""Several perception error models on one scenario: their failure probabilities and ratios."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from pemviz.arrays import FloatArray, row_sums
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.pem.judging.reweight import (
    RatioInterval,
    compare_pems,
    failing_log_weights,
    reweight,
)
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.sampling.estimates.diagnostics import weight_diagnostics
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.estimates.trust import caveats
from pemviz.sampling.estimates.weight_diagnostics import weight_figures
from pemviz.sampling.problem import sample
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling, with_absorbing_violation
from pemviz.types import Proposal, ScoredRollouts, outcome_log_likelihood


@dataclass(frozen=True)
class ModelFigures:
    """The failure probability under one model.

    Attributes:
        name: The model's.
        data: What it was trained on.
        probability: The failure probability; 0 where ``log10_probability`` is too small.
        log10_probability: ``None`` if no rollout violates.
        std_error: Of the probability.
        effective_failures: How many equally weighted violations carry it.
        unreliable_because: Why it must not be quoted; empty if nothing speaks against it.
        to_first: Ratio to the first model's, with its interval; ``None`` for the first, and if no
            rollout violates.
        interval_caveats: Why that interval does not hold at its level; empty if it does.
    """

    name: str
    data: str
    probability: float
    log10_probability: float | None
    std_error: float
    effective_failures: float
    unreliable_because: tuple[str, ...]
    to_first: RatioInterval | None
    interval_caveats: tuple[str, ...]


def compare_models(
    config: ExperimentConfig, names: Sequence[str], *, rollouts: int, allow_python: bool = False
) -> Sequence[ModelFigures]:
    """Estimate the failure probability under each model from the same rollouts.

    Misses are independent given the state unless the configuration has a memory time: a memory of a
    model's own is left out, as the models are to differ in P(detected) alone.

    ``rollouts`` are sampled from each model's zero-variance proposal; all together count as samples
    from the mixture of the proposals (balance heuristic: Veach & Guibas 1995), so that no model
    has to live on rollouts that were sampled for another.

    Args:
        config: Scenario, specification, seed; its own model and method do not matter.
        names: At least two models; ratios are to the first.
        rollouts: For each model.
        allow_python: Whether ``module:attribute`` may be imported, whose code then runs.

    Raises:
        InputError: A model cannot be loaded, or single states do not decide the specification.
    """
    if len(names) < 2:
        raise ConfigError(f"models = {', '.join(names) or 'none'}: name at least two")
    if config.frailty:
        raise ConfigError(f"frailty = {config.frailty:g}: models are compared with frailty 0 alone")
    if config.memory_law == "visibility":
        raise ConfigError("memory_law = 'visibility': models are compared with law outcomes alone")
    base = replace(
        config,
        method="zero-variance",
        final_rollouts=rollouts,
        reference=False,
        memory_s=config.assumed_memory_s if config.memory_s is None else config.memory_s,
        frailty=0.0,
    )
    experiments = [
        build_experiment(replace(base, pem=name), allow_python=allow_python) for name in names
    ]
    proposals: list[Proposal] = []
    parts: list[ScoredRollouts] = []
    seeds = np.random.SeedSequence(config.seed).spawn(len(names))
    for experiment, seed in zip(experiments, seeds, strict=True):
        method = experiment.method
        assert isinstance(method, ZeroVarianceSampling)  # noqa: S101  chosen above
        proposal = method.init(experiment.problem, repetition=0).proposal
        problem = with_absorbing_violation(experiment.problem)
        proposals.append(proposal)
        parts.append(sample(problem, proposal=proposal, count=rollouts, seeds=seed))
    scored = ScoredRollouts.concatenate(parts)
    salient, log_q = _mixture(scored, experiments, proposals)
    weighed: dict[str, Any] = {
        "detected": scored.rollouts.detected,
        "salient": salient,
        "log_q": log_q,
        "violated": scored.violated,
    }
    pems = [experiment.pem for experiment in experiments]
    answers = reweight(**weighed, members=pems)
    against: list[tuple[str, ...]] = []
    figures: list[ModelFigures] = []
    for index, (pem, log_mu, relative, effective) in enumerate(
        zip(
            pems,
            answers.log_mu.tolist(),
            answers.relative_std_error.tolist(),
            answers.effective_failures.tolist(),
            strict=True,
        )
    ):
        log_weight = failing_log_weights(**weighed, pem=pem)
        against.append(_unreliable_because(log_weight, scored.rollouts.count))
        is_finite, of_first = math.isfinite(log_mu), index == 0
        compared = not of_first and scored.violated.any()
        caveats_of_first = (f"the first model: {words}" for words in against[0])
        figures.append(
            ModelFigures(
                name=pem.name,
                data=pem.data,
                probability=math.exp(log_mu),
                log10_probability=log_mu / math.log(10.0) if is_finite else None,
                std_error=math.exp(log_mu) * relative if is_finite else 0.0,
                effective_failures=effective,
                unreliable_because=against[-1],
                interval_caveats=() if of_first else (*against[-1], *caveats_of_first),
                to_first=compare_pems(**weighed, old=pems[0], new=pem) if compared else None,
            )
        )
    return figures


def _unreliable_because(log_weight: FloatArray, count: int) -> tuple[str, ...]:
    """Why one model's figure must not be quoted, by the diagnostics of its weights."""
    log10_probability = (
        (log_sum(log_weight) - math.log(count)) / math.log(10.0) if log_weight.size else None
    )
    found = weight_diagnostics(
        weight_figures(log_weight, of=count),
        failures=log_weight.size,
        rollouts=count,
        log10_probability=log10_probability,
    )
    return caveats(found, method="zero-variance")


def _mixture(
    scored: ScoredRollouts, experiments: Sequence[Experiment], proposals: Sequence[Proposal]
) -> tuple[FloatArray, FloatArray]:
    """Salient variables of N rollouts, and the log of the mean of the proposals' densities."""
    states = scored.rollouts.decision_states()
    salient = experiments[0].problem.simulator.salient(states.signals)
    densities: list[FloatArray] = []
    for proposal, experiment in zip(proposals, experiments, strict=True):
        logit = proposal.logit(states, experiment.problem.pem.logit(salient))
        densities.append(row_sums(outcome_log_likelihood(logit, scored.rollouts.detected)))
    log_sum_of_all = np.asarray(logsumexp(np.stack(densities), axis=0))
    return salient, log_sum_of_all - math.log(len(proposals))
