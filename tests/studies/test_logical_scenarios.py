import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest
from markdown_it import MarkdownIt
from scipy import stats

from pemviz.runs.engine import run_experiment
from pemviz.types import Diagnostic, Estimate
from studies.logical_scenarios import ScenarioStudySettings, study_scenarios
from studies.logical_scenarios.__main__ import main
from studies.logical_scenarios.answers import Answer, answer, factor, factor_words, why_not, words
from studies.logical_scenarios.settings import PLAIN, WEIGHTED

SMALL = ["--logical-scenarios", "braking", "--memories-s", "0.25", "--trackers", "none",
         "--rollouts", "200", "--plain-rollouts", "1000", "--workers", "1"]  # fmt: skip
SETTINGS = ScenarioStudySettings(
    logical_scenarios=("braking",), memories_s=(0.25,), trackers=("none",), rollouts=200,
    plain_rollouts=1000, workers=1,
)  # fmt: skip


def plain_of(failures, rollouts):
    interval = stats.binomtest(failures, rollouts).proportion_ci(0.95, method="exact")
    return _estimate("monte-carlo", failures / rollouts, interval.low, interval.high, failures)


def weighted_of(probability, low, high, *kinds):
    wrong = tuple(Diagnostic(kind, None, None, kind) for kind in kinds)
    return _estimate("mixture", probability, low, high, 50 if probability else 0, wrong)


def _estimate(method, probability, low, high, failures, diagnostics=()):
    return Estimate(
        method=method, probability=probability, log10_probability=None, std_error=None,
        ci_low=low, ci_high=high, rollouts_simulated=1000, rollouts_in_estimate=1000,
        failures=failures, nll_mean=None, nll_log_mean=None, ess=None, pareto_k=None,
        max_weight_share=None, unbiased_probability=None, unbiased_std_error=None,
        diagnostics=diagnostics,
    )  # fmt: skip


GOOD, RARE = weighted_of(2e-4, 1e-4, 4e-4), weighted_of(2e-6, 1e-6, 4e-6)


@pytest.mark.parametrize(
    ("weighted", "seen", "basis"),
    [
        (GOOD, 10, "counted"),
        (weighted_of(2e-4, 1e-4, 4e-4, "parts-disagree"), 10, "counted"),
        (GOOD, 9, "weighted"),
        (GOOD, 0, "bound"),  # plain Monte Carlo would have seen it
        (RARE, 0, "weighted"),
        (weighted_of(2e-4, 1e-4, 4e-4, "parts-disagree"), 3, "few"),
        (weighted_of(2e-4, 1e-4, 4e-4, "heavy-tail"), 0, "bound"),
        (weighted_of(0.0, None, None), 0, "bound"),
        (RARE, 9, "few"),  # the plain interval begins at 4e-5
        (weighted_of(2e-6, 1e-6, 4e-6, "few-failures"), 0, "weighted"),  # does not undermine
    ],
)
def test_which_answer_counts(weighted, seen, basis):
    plain = plain_of(seen, 100_000)
    found = answer(weighted=weighted, plain=plain)
    assert found.basis == basis
    source = weighted if basis == "weighted" else plain
    assert found.high == source.ci_high
    assert found.probability == (None if basis == "bound" else source.probability)


def test_what_speaks_against_mixture_is_told_in_words():
    plain = plain_of(9, 100_000)
    assert why_not(GOOD, plain) == ()
    assert why_not(RARE, plain) == ("plain Monte Carlo differs",)
    assert why_not(weighted_of(0.0, None, None, "no-failure"), plain) == ("no-failure",)


def test_a_factor_of_two_log_normal_answers_is_log_normal():
    above = Answer("weighted", 3e-3, 3e-3 * math.exp(-0.3), 3e-3 * math.exp(0.3))
    below = Answer("weighted", 1e-3, 1e-3 * math.exp(-0.4), 1e-3 * math.exp(0.4))
    found = factor(above, below)
    assert found.value == pytest.approx(3.0)
    assert found.low == pytest.approx(3.0 * math.exp(-0.5))
    assert found.high == pytest.approx(3.0 * math.exp(0.5))


def test_intervals_of_factors_hold():
    """Of 200 intervals at 95 %, fewer than 180 hold with a chance of 0.002."""
    rng, count = np.random.default_rng(1), 2000
    held = 0
    for _ in range(200):
        above, below = (plain_of(int(rng.binomial(count, p)), count) for p in (0.02, 0.01))
        found = factor(*(answer(weighted=GOOD, plain=one) for one in (above, below)))
        held += found.low <= 2.0 <= found.high
    assert held >= 180


def test_bounds_give_one_sided_factors():
    seen, unseen = Answer("counted", 1e-3, 8e-4, 1.2e-3), Answer("bound", None, 0.0, 4e-5)
    assert factor_words(factor(seen, unseen)) == "over 20"
    assert factor_words(factor(unseen, seen)) == "below 0.050"
    assert factor_words(factor(unseen, unseen)) == "not known"
    assert words(unseen) == "below 4.0e-5"


def test_the_command_writes_everything_and_goes_on_from_what_is_done(tmp_path, capsys):
    assert main([*SMALL, "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr()
    page = (tmp_path / "scenarios.md").read_text()
    assert shown.out == page + "\n"
    assert "2 of 2: braking, memory 0.25 s, no tracker, monte-carlo" in shown.err
    html = MarkdownIt("commonmark").enable("table").render(page)
    assert html.count("<table>") == 4  # two rules, all answers, provenance; nothing to compare
    assert (tmp_path / "scenarios.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader(io.StringIO((tmp_path / "scenarios.csv").read_text())))
    by_rule = {row["rule"]: row for row in rows}
    (cell,) = SETTINGS.cells
    result = run_experiment(SETTINGS.config(cell, PLAIN))
    assert int(by_rule["any rule"]["plain_violations"]) == result.estimate.failures > 10
    for one in result.rules:
        assert int(by_rule[one.name]["plain_violations"]) == one.estimate.failures
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "cells").iterdir()}
    plain, weighted = sorted(before, key=lambda path: "mixture" in path.name)
    plain.write_text(plain.read_text()[:-40])
    study_scenarios(SETTINGS, tmp_path / "cells")
    assert weighted.stat().st_mtime_ns == before[weighted]
    assert plain.stat().st_mtime_ns > before[plain]
    again = study_scenarios(SETTINGS, tmp_path / "cells")
    assert again.csv == (tmp_path / "scenarios.csv").read_text()


def test_budgets_and_questions_of_cells():
    settings = replace(SETTINGS, logical_scenarios=("cut-in", "cut-out"), trackers=("none", "3/5"))
    for cell in settings.cells:
        config = settings.config(cell, WEIGHTED)
        assert config.rollouts * (config.stages + 1) + config.final_rollouts == 200
        assert (config.encounter.logical_scenario, config.memory_s) == (cell.logical_scenario, 0.25)
        assert config.scenario.tracker == cell.tracker
        assert settings.config(cell, PLAIN).final_rollouts == 1000


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        (
            ["--logical-scenarios", "overtaking"],
            "logical_scenarios = 'overtaking': must be of braking",
        ),
        (["--memories-s", "0.1", "0.1"], "memories_s = 0.1, 0.1: must be at least one, each once"),
        (["--memories-s", "-1"], "memory_s = -1"),
        (["--trackers", "4/3"], "4/3"),
        (["--rollouts", "10"], "rollouts = 10"),
        (["--plain-rollouts", "0"], "plain_rollouts = 0"),
        (["--workers", "0"], "workers = 0"),
        (["--seed", "-1"], "seed = -1"),
        (["--pem", "nowhere"], "nowhere"),
        (["table2"], "table2"),
    ],
)
def test_wrong_settings_are_one_line(given, complaint, tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*given, "--out", str(out)]) == 2
    shown = capsys.readouterr().err
    assert complaint in shown
    assert shown.count("\n") == 1
    assert not out.exists()
