"""Other families' answers from the same rollouts, against binomial tails and exact references."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pemviz.analysis.model_uncertainty import (
    MOST_VIOLATIONS,
    ModelClassRatios,
    model_class_answers,
    model_class_ratios,
    model_classes_beside,
    violating,
)
from pemviz.config.toml_files import load_preset
from pemviz.pem import load_pem
from pemviz.proposals.fixed import ConstantProposal
from pemviz.runs.engine import run_experiment
from pemviz.runs.result_file import result_document, result_from_document
from pemviz.sampling.problem import sample
from tests.toy import ConstantPem, exact_failure_probability

MISS = (0.02, 0.05, 0.2)
MODEL_CLASSES = tuple(ConstantPem(miss) for miss in MISS)


def drawn(problem, *, count=4_000):
    return sample(
        problem, proposal=ConstantProposal(0.5), count=count, seeds=np.random.SeedSequence(3)
    )


def answered(scored, ratios):
    log_weight = scored.rollouts.log_weight
    return model_class_answers(
        ratios,
        model_classes=MODEL_CLASSES,
        log_weight=log_weight[ratios.rollout],
        of=log_weight.size,
    )


@pytest.mark.parametrize("count", [4_000, 40_000])
def test_every_model_class_gets_its_own_answer(count, toy_problem):
    """Six z-tests at 4 standard errors: false alarm 4e-4 together; the seed is fixed."""
    scored = drawn(toy_problem, count=count)
    ratios = model_class_ratios(
        violating(scored), simulator=toy_problem.simulator, model_classes=MODEL_CLASSES
    )
    assert ratios.rollout.size == min(MOST_VIOLATIONS, scored.violated.sum())
    answers = answered(scored, ratios)
    steps = scored.rollouts.detected.shape[1]
    for answer, miss in zip(answers, MISS, strict=True):
        truth = exact_failure_probability(steps=steps, miss_probability=miss)
        error = answer.probability * answer.relative_std_error
        assert 0.0 < error < 0.2 * truth
        assert abs(answer.probability - truth) < 4 * error
        assert answer.log10_probability == pytest.approx(math.log10(answer.probability))
        assert answer.is_reliable


def test_all_violations_give_the_plain_importance_sampling_average(toy_problem):
    scored = drawn(toy_problem)
    assert scored.violated.sum() <= MOST_VIOLATIONS
    ratios = model_class_ratios(
        violating(scored), simulator=toy_problem.simulator, model_classes=MODEL_CLASSES
    )
    answers = answered(scored, ratios)
    misses, steps = (~scored.rollouts.detected).sum(axis=1), scored.rollouts.detected.shape[1]
    for answer, miss in zip(answers, MISS, strict=True):
        weight = (2 * miss) ** misses * (2 * (1 - miss)) ** (steps - misses) * scored.violated
        assert answer.probability == pytest.approx(weight.mean(), rel=1e-9)
        error = weight.std() / math.sqrt(weight.size)
        assert answer.probability * answer.relative_std_error == pytest.approx(error, rel=1e-6)
        effective = weight.sum() ** 2 / (weight**2).sum()
        assert answer.effective_failures == pytest.approx(effective, rel=1e-9)


def test_stages_together_are_one_batch(toy_problem):
    scored = drawn(toy_problem)
    half = scored.violated.size // 2
    parts = [scored.take(slice(half)), scored.take(slice(half, None))]
    pieces = [
        model_class_ratios(
            violating(part), simulator=toy_problem.simulator, model_classes=MODEL_CLASSES
        )
        for part in parts
    ]
    pieces[1] = replace(pieces[1], rollout=pieces[1].rollout + half)
    whole = model_class_ratios(
        violating(scored), simulator=toy_problem.simulator, model_classes=MODEL_CLASSES
    )
    joined = ModelClassRatios.concatenate(pieces)
    assert np.array_equal(joined.rollout, whole.rollout)
    assert np.array_equal(joined.log_ratio, whole.log_ratio)


def test_without_violations_there_is_no_answer(toy_problem):
    safe = sample(
        toy_problem,
        proposal=ConstantProposal(1.0 - 1e-12),
        count=50,
        seeds=np.random.SeedSequence(0),
    )
    assert not safe.violated.any()
    ratios = model_class_ratios(
        violating(safe), simulator=toy_problem.simulator, model_classes=MODEL_CLASSES
    )
    assert answered(safe, ratios) == ()


def test_model_classes_are_the_shipped_models_of_the_same_data():
    asked = load_pem("ml-nn")
    names = {model.name for model in model_classes_beside(asked)}
    assert {"lr", "b-nn", "gb-raw"} <= names
    assert "ml-nn" not in names
    assert not any(name.endswith("-ensemble") for name in names)
    assert all(model.data == asked.data for model in model_classes_beside(asked))
    assert model_classes_beside(ConstantPem(0.1)) == ()


EXACT = {"lr": -7.836, "b-nn": -10.544, "gb-raw": -17.134}
"""log10 by `pemviz pem compare ml-nn lr b-nn gb-raw`, each from rollouts of its own, +- 2 %."""


@pytest.mark.parametrize("seed", [0, 1])
def test_one_run_of_mixture_tells_what_the_others_answer(seed):
    """Each within 4 of its own relative standard errors, or a factor 2: false alarm below 1e-3."""
    asked = replace(load_preset("paper"), plan=False, measured_memory=False)
    result = run_experiment(replace(asked, method="mixture", seed=seed))
    answers = {answer.name: answer for answer in result.model_classes}
    assert set(answers) >= set(EXACT)
    for name, log10 in EXACT.items():
        answer = answers[name]
        off = abs(answer.log10_probability - log10)
        assert off < max(math.log10(1.0 + 4.0 * answer.relative_std_error), 0.3), name
    assert result_from_document(result_document(result)).model_classes == result.model_classes
