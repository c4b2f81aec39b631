"""Ranking from what is stored agrees with running under that metric."""

import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.panel.loading import load_run
from pemviz.panel.ranking import elites, rank, ranking_csv, row
from pemviz.panel.rollout_tables import check_table, numbered, thinned
from pemviz.panel.run_summary import summary
from pemviz.panel.why_page import failures_of, longest_runs
from tests.panel.conftest import NAIVE, wait_until

METRICS = ("classical", "agm", "smooth-cumulative")


@pytest.mark.parametrize("metric", METRICS)
def test_re_ranking_gives_the_scores_of_a_run_under_that_metric(controller, naive_run, metric):
    controller.start(replace(NAIVE, metric=metric))
    under = wait_until(controller).run
    # the naive method draws the same rollouts whatever the metric
    np.testing.assert_array_equal(under.rollouts["gap_m"], naive_run.rollouts["gap_m"])
    np.testing.assert_array_equal(rank(naive_run, metric).robustness, under.rollouts["robustness"])


def test_order_is_least_robust_first_and_classical_is_the_minimum_gap(naive_run):
    ranking = rank(naive_run, "classical")
    assert np.all(np.diff(ranking.robustness[ranking.order]) >= 0.0)
    lowest = np.min(naive_run.rollouts["gap_m"], axis=1) - 2.0
    np.testing.assert_allclose(ranking.robustness, lowest, rtol=0, atol=1e-12)


def test_row_tells_what_the_tables_hold(naive_run):
    entry = row(naive_run, rank(naive_run, "classical"), 0)
    table = naive_run.rollouts
    assert entry.rank == 1
    assert entry.misses == int(np.sum(~table["detected"][entry.index]))
    weight = float(np.sum(table["log_p"][entry.index] - table["log_q"][entry.index]))
    assert entry.log_weight == pytest.approx(weight, rel=1e-12)
    assert entry.violated == (entry.robustness < 0.0)


def test_elites_are_what_a_stage_learns_from(naive_run):
    """60 rollouts of one stage: the 57th largest lies below 0, so 0 is the level."""
    ranking = rank(naive_run, "classical")
    chosen = elites(naive_run, ranking, sigma=0.95)
    robustness = naive_run.rollouts["robustness"]
    assert np.sort(robustness)[::-1][57] < 0.0
    np.testing.assert_array_equal(chosen, robustness <= 0.0)
    assert np.sum(chosen) > 3


def test_elites_are_counted_as_the_run_counts_them(loaded_run):
    """The panel's number is the one in the run's result, stage by stage."""
    chosen = elites(loaded_run, rank(loaded_run, "classical"), sigma=0.95)
    for stage in loaded_run.result.stages:
        if stage.kind == "learn":
            rows = loaded_run.rollouts["stage"] == stage.stage
            assert np.count_nonzero(chosen[rows]) == stage.elites


def test_thinning_keeps_what_carries_the_answer(naive_run):
    (few,) = thinned(naive_run.parts, stages=naive_run.result.stages, limit=8)
    table = naive_run.rollouts
    weight = np.where(table["violated"], naive_run.log_weight, -np.inf)
    assert np.isin(np.argsort(-weight, kind="stable")[:4], few["rollout"]).all()
    assert few["violated"].size == 8
    assert np.argmin(table["robustness"]) in few["rollout"]


def test_what_carries_the_answer_makes_up_nearly_all_of_it(naive_run):
    """Against sums over the stored likelihoods, one rollout after the other."""
    table = naive_run.rollouts
    ratio = [
        math.exp(math.fsum(table["log_p"][i] - table["log_q"][i])) if table["violated"][i] else 0.0
        for i in range(table["violated"].size)
    ]
    total = math.fsum(ratio)
    ranking = rank(naive_run, "classical", among="carrying")
    chosen = ranking.order.tolist()
    rest = set(range(len(ratio))) - set(chosen)
    assert math.fsum(ratio[i] for i in chosen) >= 0.99 * total
    assert max(ratio[i] for i in rest) < min(ratio[i] for i in chosen)
    assert math.fsum(sorted((ratio[i] for i in chosen), reverse=True)[:-1]) < 0.99 * total
    assert table["violated"][chosen].all()
    assert (np.diff(table["robustness"][chosen]) >= 0.0).all()
    by_share = rank(naive_run, "classical", among="carrying", by_share=True)
    assert sorted(chosen) == sorted(by_share.order.tolist())
    assert (np.diff([ratio[i] for i in by_share.order]) <= 0.0).all()
    entry = row(naive_run, by_share, 0)
    assert entry.share == pytest.approx(max(ratio) / total, rel=1e-12)


def test_the_result_lists_what_carries_the_answer_first(naive_run):
    listed = naive_run.result.least_robust
    carrying = rank(naive_run, "classical", among="carrying").order
    expected = naive_run.rollouts["rollout"][carrying][: len(listed)].tolist()
    assert [one.rollout for one in listed][: len(expected)] == expected
    assert [one.share is not None for one in listed] == [
        place < len(expected) for place in range(len(listed))
    ]


def test_csv_has_a_line_a_rollout(naive_run):
    text = ranking_csv(naive_run, rank(naive_run, "agm"))
    lines = list(csv.DictReader(io.StringIO(text)))
    assert len(lines) == 60
    assert [int(line["rank"]) for line in lines] == list(range(1, 61))
    robustness = [float(line["robustness_agm"]) for line in lines]
    assert robustness == sorted(robustness)


def test_thinning_keeps_the_least_robust_and_their_numbers(naive_run):
    (few,) = thinned(naive_run.parts, stages=(), limit=7)
    lowest = np.sort(naive_run.rollouts["robustness"])[:7]
    np.testing.assert_array_equal(np.sort(few["robustness"]), lowest)
    for place in range(7):
        original = few["rollout"][place]
        np.testing.assert_array_equal(few["gap_m"][place], naive_run.rollouts["gap_m"][original])


def test_numbering_counts_within_repetition_and_stage():
    table = numbered({"repetition": np.array([0, 0, 0, 1, 1]), "stage": np.array([0, 1, 0, 0, 0])})
    assert table["rollout"].tolist() == [0, 0, 1, 0, 1]


def test_longest_chain_of_misses():
    missed = np.array([[1, 1, 0, 1], [0, 0, 0, 0], [1, 1, 1, 1], [0, 1, 0, 1]], dtype=bool)
    assert longest_runs(missed).tolist() == [2, 0, 4, 1]


def test_weights_of_failures_sum_to_one_and_follow_the_likelihoods(naive_run):
    failures = failures_of(naive_run)
    assert failures is not None
    assert np.sum(failures.weight) == pytest.approx(1.0)
    violated = naive_run.rollouts["violated"]
    likeliest = int(np.argmax(naive_run.log_weight[violated]))
    assert int(np.argmax(failures.weight)) == likeliest


def test_splitting_weighs_failures_by_their_runs_estimates(naive_run):
    (whole,) = naive_run.result.stages
    stages = (
        replace(whole, failures=3, log10_probability=-9.0),
        replace(whole, stage=1, failures=1, log10_probability=-10.0),
    )
    config = replace(naive_run.config, method="splitting")
    violated = np.flatnonzero(naive_run.rollouts["violated"])[:4]
    part = {name: values[violated] for name, values in naive_run.rollouts.items()}
    part |= {"stage": np.array([0, 0, 0, 1]), "log_q": part["log_p"]}
    run = replace(
        naive_run,
        result=replace(naive_run.result, config=config, stages=stages),
        parts=(part,),
    )
    failures = failures_of(run)
    assert failures is not None
    assert failures.weight == pytest.approx(np.array([10 / 33, 10 / 33, 10 / 33, 1 / 11]))


def test_ranking_by_rule(controller):
    """Robustness of a rule is its own; what counts as violated and as a share is of that rule."""
    rules = {"gap": "always[0,99] (gap >= 2.0)", "far": "always[0,99] (gap >= 3.0)"}
    controller.start(NAIVE.with_rules(rules))
    run = wait_until(controller).run
    least = np.min(run.rollouts["gap_m"], axis=1)
    for name, at_least in (("gap", 2.0), ("far", 3.0), (None, 3.0)):
        ranking = rank(run, "classical", among="carrying", rule=name)
        np.testing.assert_allclose(ranking.robustness, least - at_least, rtol=0, atol=1e-12)
        assert {int(i) for i in ranking.order} <= set(np.flatnonzero(least < at_least))
        assert float(ranking.share[least >= at_least].sum()) == 0.0
        assert math.isclose(float(ranking.share.sum()), 1.0)
        first = row(run, ranking, 0)
        assert first.broken == (("gap", "far") if least[first.index] < 2.0 else ("far",))
    lines = list(csv.DictReader(io.StringIO(ranking_csv(run, rank(run, "classical")))))
    assert {line["breaks"] for line in lines} <= {"gap far", "far", ""}
    again = load_run(run.folder)
    assert row(again, rank(again, "classical", rule="far"), 0).broken == row(run, rank(
        run, "classical", rule="far"), 0).broken  # fmt: skip
    assert summary(run.result)["rule"] in rules


def test_a_stored_run_without_a_rules_column_is_refused(naive_run):
    """Rules are in its configuration, and what broke them is not in its rollouts."""
    config = naive_run.config.with_rules({"far": "always[0,99] (gap >= 3.0)"})
    with pytest.raises(InputError, match=r"broken\.far is absent"):
        check_table(naive_run.rollouts, config, where="here")


def test_weights_and_shares_count_latents(controller):
    """Measured distances err: what moved their noise is part of a rollout's weight."""
    config = ExperimentConfig(
        method="mixture", stages=2, rollouts=60, final_rollouts=60, seed=5, chains=0,
        position_errors="pointpillars",
    )  # fmt: skip
    controller.start(config)
    run = wait_until(controller).run
    table = run.rollouts
    of_outcomes = (table["log_p"] - table["log_q"]).sum(axis=1)
    # noise is drawn from (1 - c) N(0, 1) + c ((1 - j) N(mean, 1) + j N(narrow_mean, sd^2))
    names = ("noise", "noise_mean", "noise_share", "noise_sd")
    z, mean, share, sd = (table[f"latents.{n}"] for n in names)
    around, j = (table[f"latents.noise_narrow_{n}"] for n in ("mean", "share"))
    narrow = np.exp((0.5 * z**2 - 0.5 * ((z - around) / sd) ** 2).sum(axis=2)) / sd.prod(axis=2)
    moved = j * narrow + (1.0 - j) * np.exp((mean * (z - 0.5 * mean)).sum(axis=2))
    of_latents = -np.log1p(share * (moved - 1.0)).sum(axis=1)
    of_latents = of_latents + table["latents.start_log_weight"]
    assert np.abs(of_latents).max() > 1.0
    np.testing.assert_allclose(run.log_weight, of_outcomes + of_latents, rtol=1e-9, atol=1e-9)
    stored = load_run(run.folder)
    np.testing.assert_array_equal(stored.log_weight, run.log_weight)
    first = run.result.least_robust[0]
    shown = rank(run, config.metric, among="carrying")
    assert row(run, shown, 0).share == pytest.approx(first.share, rel=1e-12)
    for name, values, said in (
        ("noise_mean", mean[:, :-1], "must be finite numbers of shape"),
        ("noise_narrow_mean", around * np.nan, "must be finite numbers of shape"),
        ("noise_share", share + 1.0, "must be from 0 to 1"),
        ("noise_narrow_share", j - 1.0, "must be from 0 to 1"),
        ("noise_sd", 0.0 * sd, "must be above 0"),
        ("start_log_weight", np.full(len(z), np.inf), "must be finite numbers of shape"),
    ):
        damaged = {**table, f"latents.{name}": values}
        with pytest.raises(InputError, match=rf"latents\.{name} {said}"):
            check_table(damaged, config, where="here")
