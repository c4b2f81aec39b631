"""The accuracy study: its arithmetic, and one small study from end to end."""

import json
import math

import pytest

from benchmarks.accuracy import (
    Case,
    Outcome,
    accuracy_table,
    measure,
    summarise,
    with_budget,
)
from benchmarks.accuracy_report import accuracy_lines, write_accuracy
from benchmarks.accuracy_study import AccuracyStudy, check_study
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import InputError
from pemviz.runs.experiment import build_experiment


@pytest.mark.parametrize("rollouts", [24, 1200, 2399, 2400, 11_000, 100_000])
@pytest.mark.parametrize("method", ["adaptive", "mixture"])
def test_budgets_are_kept_to_the_rollout(method, rollouts):
    config = with_budget(ExperimentConfig(), method=method, rollouts=rollouts)
    assert (config.stages + 1) * config.rollouts + config.final_rollouts == rollouts


@pytest.mark.parametrize("rollouts", [60, 1200, 11_000])
@pytest.mark.parametrize(
    "method",
    ["adaptive", "mixture", "zero-variance", "splitting", "subset", "monte-carlo", "naive"],
)
def test_every_method_spends_what_it_is_given(method, rollouts):
    """Counted as a run counts them: by splitting and subset, their particles."""
    config = with_budget(ExperimentConfig(), method=method, rollouts=rollouts)
    assert build_experiment(config).planned_rollouts == rollouts


def test_the_papers_budget_is_the_papers():
    config = with_budget(ExperimentConfig(), method="adaptive", rollouts=1200)
    assert (config.rollouts, config.final_rollouts) == (100, 100)


def test_too_few_rollouts_are_refused():
    with pytest.raises(InputError, match="at least 24"):
        with_budget(ExperimentConfig(), method="mixture", rollouts=23)


def test_figures_of_known_outcomes():
    outcomes = [
        Outcome(ratio=ratio, covers=covers, rollouts=10, wall_s=wall)
        for ratio, covers, wall in ((0.5, False, 1.0), (1.0, True, 2.0), (1.5, True, 9.0))
    ]
    row = summarise(outcomes, scenario="paper", method="mixture", truth=1e-3)
    assert row.relative_rmse == pytest.approx(math.sqrt(0.5 / 3))
    assert row.median_ratio == 1.0
    assert row.coverage == pytest.approx(2 / 3)
    # Clopper and Pearson for 2 of 3
    assert row.coverage_low == pytest.approx(0.0943, abs=1e-4)
    assert row.coverage_high == pytest.approx(0.9916, abs=1e-4)
    assert row.median_wall_s == 2.0


def test_a_small_study(tmp_path):
    """Two workers give the outcomes of one; the report holds them."""
    scenario = ScenarioConfig(states=45, emergency_gap_m=12.0)
    config = ExperimentConfig(scenario=scenario, spec="always[0,44] (gap >= 8.0)")
    cases = [
        Case("short", with_budget(config, method=method, rollouts=48), 1e-3)
        for method in ("zero-variance", "mixture")
    ]
    alone, together = (measure(cases, seeds=2, workers=workers) for workers in (1, 2))
    for case in cases:
        assert [o.ratio for o in alone[case]] == [o.ratio for o in together[case]]
        assert all(outcome.rollouts == 48 for outcome in alone[case])
    rows = accuracy_table(alone)
    assert len(accuracy_lines(rows)) == 2 + len(rows) == 4
    table, data, picture = write_accuracy(rows, tmp_path)
    assert "zero-variance" in table.read_text(encoding="utf-8")
    assert len(json.loads(data.read_text(encoding="utf-8"))["rows"]) == 2
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_unknown_scenarios_are_refused():
    with pytest.raises(InputError, match="scenarios = 'moon'"):
        check_study(AccuracyStudy(scenarios=("moon",)))
