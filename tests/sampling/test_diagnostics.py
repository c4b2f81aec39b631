"""Diagnostics: what makes each, what it says, and what it makes unreliable."""

import ast
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy import stats

from pemviz.proposals.fixed import PemProposal
from pemviz.reports.gate import interval_caveats
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.estimates.diagnostics import (
    FEW_FAILURES,
    LARGE_SHARE,
    LIGHT_LOAD,
    MEANINGS,
    RELIABLE_PARETO_K,
    SMALL_ESS,
    called_safe,
    chains_disagreement,
    classified,
    count_diagnostics,
    exploration_alone,
    hardly_sampled,
    lost_rollouts,
    not_absorbing,
    not_repeatable,
    not_searched,
    parts_disagreement,
    plain_disagreement,
    reference_disagreement,
    reliable_pareto_k,
    uneven_sides,
    unreliable_reference,
    weight_diagnostics,
)
from pemviz.sampling.estimates.estimators import importance_sampling_estimate
from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.sampling.estimates.weight_diagnostics import WeightFigures, weight_figures
from pemviz.sampling.particles.estimate import died_out, spread_diagnostics, width_diagnostics
from pemviz.sampling.rollouts.large_stages import WeighedRollouts
from pemviz.types import DiagnosticKind
from tests.toy import estimate_of, splitting_runs

PACKAGE = Path(__file__).resolve().parents[2] / "pemviz"


def kinds(estimate):
    return [one.kind for one in estimate.diagnostics]


def weighted(weights, *, rollouts=100, log_scale=0.0):
    """An estimate from failures with these weights among ``rollouts``."""
    batch = WeighedRollouts(
        count=rollouts,
        row=np.arange(len(weights)),
        log_weight=np.log(weights) + log_scale,
        log_p=np.full(len(weights), -5.0),
    )
    return importance_sampling_estimate(batch, method="naive", rollouts_simulated=rollouts)


def counted(problem, *, rollouts, seed=0, repetition=0):
    method = DirectSampling(
        name="monte-carlo", proposal=PemProposal(), rollouts=rollouts, seed=seed
    )
    return estimate_of(method, problem, repetition=repetition)


def split(problem, *, stages, rollouts=20, repetition=0):
    method = splitting_runs(stages=stages, rollouts=rollouts, seed=3)
    return estimate_of(method, problem, repetition=repetition)


def impossible(problem):
    """No rollout violates, whatever is missed."""
    return replace(
        problem,
        robustness=lambda signals: np.min(signals["gap"], axis=1) + 100.0,
        violated=lambda signals: np.zeros(signals["gap"].shape[0], dtype=np.bool_),
    )


def test_equal_weights_and_many_failures_are_no_diagnosis(toy_problem):
    assert kinds(weighted(np.ones(30))) == []
    assert kinds(counted(toy_problem, rollouts=20_000)) == []
    assert kinds(split(toy_problem, stages=5, rollouts=200)) == []


def test_uneven_weights_with_figures_known_by_hand():
    """Weights 1 and 29 x 0.01: share 1 / 1.29, effective size 1.29^2 / 1.0029."""
    found = weighted([1.0, *[0.01] * 29])
    assert kinds(found) == ["large-weight", "few-effective-samples"]
    share, ess = found.diagnostics
    assert (share.value, share.limit) == (pytest.approx(1 / 1.29), 0.2)
    assert (ess.value, ess.limit) == (pytest.approx(1.29**2 / 1.0029), 10.0)
    assert share.text == "one rollout carries 78% of the weight: do not quote this number"
    assert ess.text == (
        "a few weights carry the estimate: the 30 failures count as 1.7 (effective sample size)"
    )
    assert interval_caveats(found) == (
        "one rollout carries 78% of the weight",
        "the effective sample size is 1.7",
    )


def test_a_heavy_tail():
    """4,000 weights from a Pareto tail of index 1.5, whose mean does not exist."""
    generator = np.random.default_rng(1)
    weight = 1.0 + stats.genpareto.rvs(1.5, size=4_000, random_state=generator)
    found = weighted(weight, rollouts=5_000)
    tail = found.diagnostics[-1]
    assert (tail.kind, tail.value, tail.limit) == ("heavy-tail", found.pareto_k, 0.7)
    assert interval_caveats(found)[-1] == f"Pareto k-hat is {found.pareto_k:.2f}"


def test_a_tail_of_ties_that_carries_little_is_no_diagnosis():
    """As few chains of outcomes make it: 906 weights of 1, and 94 of four kinds above it.

    These are the tail, whose excess is 5 + 10 / 100 + 25e-4 + 54e-6. Of 1,200 rollouts the rest,
    1,000 weights of 1, has the variance of a count: 1000 x 200 / 1200.
    """
    kinds_above = [np.full(54, 1e-6), np.full(25, 1e-4), np.full(10, 0.01), np.full(5, 1.0)]
    weight = 1.0 + np.concatenate([np.zeros(906), *kinds_above])
    figures = weight_figures(np.log(weight), of=1_200)
    assert figures.pareto_k > 2.0
    assert figures.tail_load == pytest.approx(5.102554 / math.sqrt(1000 * 200 / 1200))
    assert kinds(weighted(weight, rollouts=1_200)) == []
    # where all fail there is no chance in the rest
    assert kinds(weighted(weight, rollouts=1_000)) == ["heavy-tail"]


@pytest.mark.parametrize(("largest", "heavy"), [(0.9, False), (19.0, True)])
def test_the_same_shape_is_no_diagnosis_where_it_is_scaled_down(largest, heavy):
    """Bounded weights, as a defensive share of 5 % makes them: none is above 20.

    A tail of 94 in steps of a ratio r carries (1 - r^94) / (1 - r) times its largest excess, and
    1,000 of 100,000 have a variance of 1000 x 0.99.
    """
    ratio = 1e-7 ** (1 / 93)
    weight = 1.0 + np.concatenate([np.zeros(906), largest * ratio ** np.arange(94)])
    figures = weight_figures(np.log(weight), of=100_000)
    assert figures.pareto_k > 4.0
    carried = largest * (1.0 - ratio**94) / (1.0 - ratio)
    assert figures.tail_load == pytest.approx(carried / math.sqrt(990.0))
    assert kinds(weighted(weight, rollouts=100_000)) == ["heavy-tail"] * heavy


def test_the_error_of_rounding_is_no_tail():
    """1 in every rollout, but for the last digits: nothing else could make an error at all."""
    digits = np.random.default_rng(2).standard_cauchy(1_000) * 1e-15
    figures = weight_figures(digits, of=1_000)
    assert figures.pareto_k > RELIABLE_PARETO_K
    assert kinds(weighted(np.exp(digits), rollouts=1_000)) == []


@pytest.mark.parametrize(
    ("count", "limit"), [(10, 0.0), (100, 0.5), (1_000, 2 / 3), (10_000, 0.7), (10**9, 0.7)]
)
def test_the_fewer_weights_the_lighter_their_tail_must_be(count, limit):
    assert reliable_pareto_k(count) == pytest.approx(limit)
    figures = WeightFigures(ess=99.0, pareto_k=limit + 1e-9, max_weight_share=0.1, tail_load=5.0)
    asked = {"failures": count, "rollouts": 10**9, "log10_probability": -15.0}
    (tail,) = weight_diagnostics(figures, **asked)
    assert (tail.kind, tail.limit) == ("heavy-tail", pytest.approx(limit))
    assert weight_diagnostics(replace(figures, pareto_k=limit - 1e-9), **asked) == ()


@pytest.mark.parametrize("shape", [0.8, 0.9, 1.5])
@pytest.mark.parametrize(("failing", "rollouts"), [(100, 110), (100, 300), (1_000, 3_000)])
def test_what_a_pareto_tail_is_warned_of_it_is_warned_of_still(shape, failing, rollouts):
    """All of 100 samples whose k-hat is above 0.7: such a tail always carries enough."""
    generator = np.random.default_rng(4)
    for _ in range(100):
        excess = stats.genpareto.rvs(shape, size=failing, random_state=generator)
        figures = weight_figures(np.log1p(0.5 * excess), of=rollouts)
        if figures.pareto_k > RELIABLE_PARETO_K:
            assert figures.tail_load > LIGHT_LOAD


@pytest.mark.parametrize(
    ("figures", "kind"),
    [
        ({"max_weight_share": math.nextafter(LARGE_SHARE, 1.0)}, "large-weight"),
        ({"ess": math.nextafter(SMALL_ESS, 0.0)}, "few-effective-samples"),
        ({"pareto_k": math.nextafter(RELIABLE_PARETO_K, 1.0), "tail_load": 5.0}, "heavy-tail"),
        ({"pareto_k": 5.0, "tail_load": math.nextafter(LIGHT_LOAD, 2.0)}, "heavy-tail"),
    ],
)
def test_limits_themselves_are_allowed(figures, kind):
    at_the_limits = WeightFigures(
        ess=SMALL_ESS,
        pareto_k=RELIABLE_PARETO_K,
        max_weight_share=LARGE_SHARE,
        tail_load=LIGHT_LOAD,
    )
    asked = {"failures": 4_000, "rollouts": 10_000, "log10_probability": -15.0}
    assert weight_diagnostics(at_the_limits, **asked) == ()
    (found,) = weight_diagnostics(replace(at_the_limits, **figures), **asked)
    assert found.kind == kind
    assert found.value != found.limit


def test_limits_are_those_of_the_literature_and_of_the_page_on_uncertainty():
    page = (PACKAGE.parent / "docs" / "explanation" / "uncertainty.md").read_text(encoding="utf-8")
    assert (RELIABLE_PARETO_K, SMALL_ESS, LARGE_SHARE, FEW_FAILURES) == (0.7, 10.0, 0.2, 10)
    assert f"below {SMALL_ESS:g}, a few weights carry the estimate: do not quote it" in page
    assert f"| above {RELIABLE_PARETO_K:g} the weights' tail is too heavy" in page
    assert f"one rollout carries over {LARGE_SHARE:.0%}".replace("%", " %") in page


def test_a_count_is_reliable_however_few_were_counted(toy_problem):
    """Its interval is exact; without a failure it is an upper bound."""
    none, few = counted(toy_problem, rollouts=20), counted(toy_problem, rollouts=3_000)
    assert (kinds(none), none.failures) == (["no-failure"], 0)
    assert (kinds(few), 0 < few.failures < 10) == (["few-failures"], True)
    assert few.warnings == (f"only {few.failures} failures were seen: the interval is wide",)
    (one,) = count_diagnostics(failures=1, rollouts=3_000, upper=0.1, confidence=0.95)
    assert one.text == "only 1 failure was seen: the interval is wide"
    assert classified((one.text,), few)[0].kind == "few-failures"
    assert interval_caveats(none) == interval_caveats(few) == ()
    assert none.ci_high is not None


def test_nothing_seen_under_weights_says_nothing():
    found = weighted([])
    assert kinds(found) == ["no-failure"]
    assert found.ci_high is None
    assert interval_caveats(found) == found.warnings


def test_runs_of_splitting_that_die_out_or_stand_alone(toy_problem):
    dead = split(impossible(toy_problem), stages=3)
    assert kinds(dead) == ["died-out"]
    assert dead.warnings == (
        "in 3 of 3 runs no particle reached a violation: ask for more particles",
    )
    assert dead.diagnostics[0].value == 3.0
    alone = split(toy_problem, stages=1, rollouts=200)
    assert kinds(alone) == ["few-runs"]
    assert alone.std_error is None
    assert interval_caveats(dead)
    assert interval_caveats(alone)


def test_a_probability_below_doubles_is_no_doubt_about_it():
    found = weighted(np.ones(30), log_scale=-1000.0)
    assert kinds(found) == ["below-doubles"]
    assert found.probability == 0.0
    assert found.diagnostics[0].value == found.log10_probability
    assert interval_caveats(found) == ()


def test_repetitions_count_what_is_wrong_with_how_many():
    """By hand: the first is even, the second has one large weight, the third no failure."""
    found = summarise_repetitions(
        [weighted(np.ones(30)), weighted([1.0, *[0.01] * 20]), weighted([])]
    )
    assert found.warnings == (
        "in 1 of 3 repetitions no failure was seen",
        "in 1 of 3 repetitions one rollout carries over 20% of the weight",
        "in 1 of 3 repetitions a few weights carry the estimate (effective sample size below 10)",
    )
    assert [one.value for one in found.diagnostics] == [
        0.0, pytest.approx(1 / 1.2), pytest.approx(1.2**2 / 1.002)
    ]  # fmt: skip
    assert interval_caveats(found) == (
        "in 1 of 3 repetitions no failure was seen",
        "one rollout carries 83% of the weight",
        "the effective sample size is 1.4",
    )


def test_repetitions_keep_their_values_the_least_favourable():
    heavy, heavier = weighted([1.0, *[0.02] * 29]), weighted([1.0, *[0.01] * 29])
    together = {one.kind: one.value for one in summarise_repetitions([heavy, heavier]).diagnostics}
    worse = {one.kind: one.value for one in heavier.diagnostics}
    assert together["large-weight"] == worse["large-weight"]
    assert together["few-effective-samples"] == worse["few-effective-samples"]


def test_repetitions_of_splitting_tell_of_runs_that_died(toy_problem):
    sound, dead = (split(p, stages=2) for p in (toy_problem, impossible(toy_problem)))
    found = summarise_repetitions([sound, dead, sound])
    assert "no particle reached a violation" in " ".join(found.warnings)
    assert interval_caveats(found)


def test_repetitions_of_single_runs_have_an_error_but_no_interval(toy_problem):
    found = summarise_repetitions(
        [split(toy_problem, stages=1, rollouts=200, repetition=r) for r in range(3)]
    )
    assert found.std_error is not None
    assert (found.ci_low, found.ci_high) == (None, None)
    assert kinds(found) == ["few-runs"]
    assert interval_caveats(found)


def test_a_mean_below_doubles_says_so():
    found = summarise_repetitions([weighted(np.ones(30), log_scale=-1000.0)] * 2)
    assert kinds(found) == ["below-doubles"]


def one_of_each_kind():
    """Kind to its diagnostics, made where methods make them."""
    figures = WeightFigures(ess=2.0, pareto_k=1.0, max_weight_share=0.5, tail_load=5.0)
    asked = {"rollouts": 100, "upper": 0.03, "confidence": 0.95}
    lost = {"count": 3, "rollouts": 100, "otherwise": 0.1, "std_error": 0.01}
    estimate = weighted(np.ones(30))
    every = [
        *count_diagnostics(failures=0, **asked),
        *count_diagnostics(failures=3, **asked),
        *weight_diagnostics(figures, failures=5, rollouts=100, log10_probability=-400.0),
        *weight_diagnostics(figures, failures=0, rollouts=100, log10_probability=None),
        died_out(died=1, runs=2),
        *spread_diagnostics(runs=2, spread_nats=3.0, common_ancestry=0.9),
        *width_diagnostics(probability=1e-9, low=1e-10, high=2e-9),
        not_absorbing(),
        *not_repeatable(repeated=20, differing=1, example="gap 1 and 2 at step 3"),
        *lost_rollouts(counts_as="violation", probability=0.03, **lost),
        *lost_rollouts(counts_as="none", probability=0.001, **lost),
        *lost_rollouts(counts_as="none", probability=0.03, **lost),
        *unreliable_reference(["its tail is heavy"]),
        *called_safe(0.1, relative_error=0.01),
        *parts_disagreement(late=3.5, halves=1.0),
        *exploration_alone(0.3),
        *uneven_sides([figures]),
        *plain_disagreement(0.5, low=0.01, high=0.03, failures=20, rollouts=1_000),
        *hardly_sampled(by_chains=0.5, by_weights=0.1),
        *chains_disagreement(more=2.0, allowed=0.5),
        not_searched(),
        *reference_disagreement(estimate, probability=1e-20, std_error=0.0),
        *summarise_repetitions([weighted([]), weighted([1.0, *[0.01] * 29])]).diagnostics,
    ]
    made = {kind: [one for one in every if one.kind == kind] for kind in get_args(DiagnosticKind)}
    return {kind: found for kind, found in made.items() if kind != "unclassified"}


def test_every_kind_is_made_and_has_a_meaning():
    assert set(MEANINGS) == set(get_args(DiagnosticKind))
    assert all(one_of_each_kind().values())


def test_older_files_kept_the_texts_alone():
    """Each text leads to its kind, with the value that the estimate's figures have."""
    for kind, made in one_of_each_kind().items():
        for one in made:
            (found,) = classified([one.text], weighted(np.ones(30)))
            assert (found.kind, found.text) == (kind, one.text)
    uneven = weighted([1.0, *[0.01] * 29])
    assert classified(uneven.warnings, uneven) == uneven.diagnostics
    (strange,) = classified(["what nobody wrote"], uneven)
    assert strange.kind == "unclassified"


def test_agreement_with_the_reference_within_the_interval_or_three_errors():
    """30 equal weights of 100: p = 0.3, standard error sqrt(0.3 x 0.7 / 99)."""
    found = weighted(np.ones(30))
    error = math.sqrt(0.3 * 0.7 / 99)
    log_error = math.sqrt(math.log1p((error / 0.3) ** 2))
    inside, near, far = 0.3 + error, 0.3 + 2.9 * error, 0.3 + 3.1 * error
    assert reference_disagreement(found, probability=inside, std_error=0.0) == ()
    assert found.ci_high < near
    assert reference_disagreement(found, probability=near, std_error=0.0) == ()
    (one,) = reference_disagreement(found, probability=far, std_error=0.0)
    assert (one.value, one.limit) == (pytest.approx(3.1), 3.0)
    assert reference_disagreement(found, probability=far, std_error=error) == ()
    below = 0.3 * math.exp(-2.9 * log_error)
    assert found.ci_low > below
    assert reference_disagreement(found, probability=below, std_error=0.0) == ()


def test_an_estimate_many_times_too_high_disagrees_with_the_reference():
    """Its own standard error is as large as itself: on a linear scale it is nowhere far off."""
    found = weighted([1.0, *[1e-3] * 29])
    assert found.std_error > 0.3 * found.probability
    known = found.probability * math.exp(
        -3.1 * math.sqrt(math.log1p((found.std_error / found.probability) ** 2))
    )
    assert found.probability - known < 3.0 * found.std_error
    (one,) = reference_disagreement(found, probability=known, std_error=0.0)
    assert one.value == pytest.approx(3.1)
    (none,) = reference_disagreement(weighted([]), probability=known, std_error=0.0)
    assert none.value is None
    (zero,) = reference_disagreement(found, probability=0.0, std_error=0.0, trusted=False)
    assert "unreliable too" in zero.text
    assert reference_disagreement(weighted([]), probability=0.0, std_error=0.0) == ()


def test_what_is_called_safe_is_compared_with_the_standard_error():
    assert called_safe(0.0, relative_error=0.004) == ()
    assert called_safe(0.003, relative_error=0.004) == ()
    (more,) = called_safe(0.05, relative_error=0.004)
    assert (more.value, more.limit) == (0.05, 0.004)
    assert "5.0%" in more.text
    (without_failures,) = called_safe(1.0, relative_error=None)
    assert without_failures.limit == 0.0


def test_no_text_of_the_package_retypes_a_limit():
    """Outside of the one file, limits in texts are filled in from it."""
    spoken = re.compile(r"k-hat|effective (sample|rollout)|do not quote|reliable", re.I)
    limits = re.compile(r"\b(0\.7|10)\b")
    retyped = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and spoken.search(node.value)
        and limits.search(node.value)
    ]
    assert retyped == []
