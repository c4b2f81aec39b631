"""Budgets held against run folders: which interval of a run counts, and when nothing is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import expit

from pemviz.analysis.risk_factors import impact_speeds
from pemviz.errors import InputError
from pemviz.files.array_files import read_arrays
from pemviz.runs import risk_budget
from pemviz.runs.reading import read_result
from pemviz.runs.result_file import write_result
from pemviz.runs.risk_budget import judge_budget
from tests.budgets import (
    COUNTED,
    CUT_IN,
    DOUBTED,
    HIGHEST,
    WEIGHED,
    hazard,
    look_at_memories,
    make_run,
    write_budget,
)

CURVE = 'intercept = -4.0\nslope = 0.1\nspeed_unit = "km/h"\nsource = "made up"'
SAMPLING = "uncertainty = 'sampling'"
EXACT = 'median = 1.0\nlow = 1.0\nhigh = 1.0\nsource = "each counts"'
ONCE = 'median = 1.0\nlow = 1.0\nhigh = 1.0\nsource = "by definition"'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Runs by counting and by weights; ``looked`` was looked at with memories of misses too."""
    found = tmp_path_factory.mktemp("runs")
    configs = {"counted": COUNTED, "looked": COUNTED, "weighed": WEIGHED, "cut-in": CUT_IN}
    for name, config in configs.items():
        make_run(found / name, config)
    look_at_memories(found / "looked")
    return found


def judged(folder, *hazards, accepted=1e-5):
    return judge_budget(write_budget(folder / "budget.toml", *hazards, accepted=accepted))


def alone(folder, run, **named):
    """A budget in which all but P(violation) is exactly 1, so that it is the rate of harm."""
    one = hazard(runs=(run,), encounters=ONCE, harm=EXACT, **named)
    return judged(folder, one)


def test_a_counting_run_gives_its_exact_binomial_interval(folder):
    found = alone(folder, "counted", extra=SAMPLING).risk.harm_per_hour
    exact = stats.binomtest(16, 400).proportion_ci(0.95, method="exact")
    assert found.value == pytest.approx(0.04)
    assert (found.low, found.high) == pytest.approx((exact.low, exact.high), rel=1e-3)


def test_a_weighing_run_gives_its_own_interval(folder):
    found = alone(folder, "weighed", extra=SAMPLING).risk.harm_per_hour
    estimate = read_result(folder / "weighed").estimate
    assert found.value == pytest.approx(estimate.probability)
    assert found.low == pytest.approx(estimate.ci_low, rel=1e-3)
    assert found.high == pytest.approx(estimate.ci_high, rel=1e-3)


def test_by_default_the_range_to_act_on_counts_and_its_ends_are_not_averaged(folder):
    one = alone(folder, "looked")
    assert one.risk.harm_per_hour.high == pytest.approx(HIGHEST)
    assert one.risk.harm_per_hour.low == pytest.approx(0.9e-6)
    assert one.hazards[0].runs[0].answer.open.decided_by.kind == "memory"


def test_where_nobody_looked_how_far_the_answer_is_open_the_budget_is_not_known(folder):
    one = alone(folder, "counted")
    assert one.outcome == "not known"
    assert "not looked at" in one.hazards[0].unknown


def test_what_is_known_may_be_too_much_whatever_else_is_not(folder):
    unknown, known = hazard(runs=("counted",)), hazard(name="other")
    assert judged(folder, unknown, known).outcome == "not known"
    assert judged(folder, unknown, known, accepted=1e-8).outcome == "not met"


def test_a_run_that_warns_or_did_not_finish_makes_nothing_met(tmp_path):
    make_run(tmp_path / "doubted", DOUBTED)
    one = judged(tmp_path, hazard(runs=("doubted",), extra=SAMPLING), accepted=1.0)
    assert one.outcome == "not known"
    assert "the sampling does not hold" in one.hazards[0].unknown
    stopped = make_run(tmp_path / "stopped", replace(COUNTED, final_rollouts=50))
    write_result(stopped, replace(read_result(stopped), status="stopped"))
    one = judged(tmp_path, hazard(runs=("stopped",), extra=SAMPLING), accepted=1.0)
    assert one.hazards[0].unknown == "run stopped: the run stopped"


def test_of_several_runs_the_highest_and_the_lowest_ends_count(folder):
    one = hazard(runs=("counted", "weighed"), extra=SAMPLING, encounters=ONCE, harm=EXACT)
    found = judged(folder, one).risk.harm_per_hour
    assert found.low == pytest.approx(read_result(folder / "weighed").estimate.ci_low, rel=1e-3)
    exact = stats.binomtest(16, 400).proportion_ci(0.95, method="exact")
    assert found.high == pytest.approx(exact.high, rel=1e-3)


def test_two_rules_of_one_run_are_not_taken_as_independent(folder):
    """The same rollouts: both are high together, so the ends add up."""
    both = [hazard(name=n, runs=("weighed",), extra=SAMPLING, encounters=ONCE, harm=EXACT)
            for n in ("first", "second")]  # fmt: skip
    one = judged(folder, *both)
    high = read_result(folder / "weighed").estimate.ci_high
    assert one.risk.harm_per_hour.high == pytest.approx(2.0 * high, rel=1e-3)
    assert any("counts several times" in text for text in one.cautions)


def closing_where_they_touch(gap_m):
    """How fast gaps ``[V, T]`` close in the step to 2 m, of 0.05 s, and whether they come to it."""
    touching = gap_m <= 2.0
    first = np.argmax(touching, axis=1)[:, np.newaxis]
    before = np.take_along_axis(gap_m, np.maximum(first - 1, 0), axis=1)
    return (before - np.take_along_axis(gap_m, first, axis=1))[:, 0] / 0.05, touching.any(axis=1)


def test_an_injury_curve_is_averaged_over_the_violating_rollouts(folder):
    """By their weights, at the speed at which the gap closes where the cars touch."""
    one = judged(folder, hazard(runs=("weighed",), extra=SAMPLING, harm=CURVE))
    arrays = read_arrays(folder / "weighed" / "rollouts.npz")
    rows = np.flatnonzero(arrays["violated"])
    weight = np.exp(arrays["method.log_weight"][rows])
    speed, hit = closing_where_they_touch(arrays["gap_m"][rows])
    risk = np.where(hit, expit(-4.0 + 0.1 * 3.6 * speed), 0.0)
    assert one.risk.hazards[0].harm.value == pytest.approx(np.average(risk, weights=weight), 1e-3)


def test_of_several_runs_p_harm_has_the_lowest_and_the_highest_end(folder):
    named = {"harm": CURVE, "encounters": ONCE, "extra": SAMPLING}
    ends = {}
    for runs in (("counted",), ("weighed",), ("counted", "weighed")):
        (one,) = judged(folder, hazard(runs=runs, **named)).risk.hazards
        ends[runs] = one.harm.low, one.harm.high
    both = ends.pop(("counted", "weighed"))
    lows, highs = zip(*ends.values(), strict=True)
    assert both == pytest.approx((min(lows), max(highs)), rel=2e-3)
    assert lows[0] != pytest.approx(lows[1], rel=2e-2)


@pytest.mark.parametrize(
    ("curve", "words"),
    [
        (CURVE, "taken as known exactly"),
        (
            f"{CURVE}\nslope_std_error = 0.01".replace("0.1\n", "-0.1\n"),
            "faster impacts would harm",
        ),
    ],
)
def test_curves_that_are_hardly_meant_so_are_named(folder, curve, words):
    found = judged(folder, hazard(runs=("counted",), harm=curve, extra=SAMPLING))
    assert sum(words in caution for caution in found.cautions) == 1


def test_violations_that_hit_nothing_are_told_where_others_hit(folder, monkeypatch):
    speed, hit = np.array([5.0, 6.0, 7.0, 0.0] * 20), np.array([True, True, True, False] * 20)
    speeds = impact_speeds(speed, hit=hit, weight=np.ones(80))
    monkeypatch.setattr(risk_budget, "run_impact_speeds", lambda *_, **__: speeds)
    found = judged(folder, hazard(runs=("counted",), harm=CURVE, extra=SAMPLING))
    assert any("25% of the violations hit nothing" in caution for caution in found.cautions)


def test_of_splitting_it_is_the_runs_that_tell_how_sure_p_harm_is(tmp_path):
    """By the particles' number it would look several times surer than it is."""
    config = replace(WEIGHED, method="splitting", stages=8, rollouts=300)
    make_run(tmp_path / "run", config)
    one = judged(tmp_path, hazard(runs=("run",), extra=SAMPLING, harm=CURVE))
    arrays = read_arrays(tmp_path / "run" / "rollouts.npz")
    rows = np.flatnonzero(arrays["violated"])
    speed, _ = closing_where_they_touch(arrays["gap_m"][rows])
    risk, run = expit(-4.0 + 0.36 * speed), arrays["stage"][rows]
    stages = {stage.stage: stage for stage in read_result(tmp_path / "run").stages}
    numbers = np.unique(run).tolist()
    share = np.array([stages[number].probability for number in numbers])
    share /= share.sum()
    each = np.array([risk[run == number].mean() for number in numbers])
    mean = float(share @ each)
    error = math.sqrt(float(np.sum((share * (each - mean)) ** 2)) * 8 / 7)
    found = one.risk.hazards[0].harm
    assert found.value == pytest.approx(mean, rel=1e-3)
    factor = math.exp(stats.t.ppf(0.975, 7) * error / mean)
    assert (found.low, found.high) == pytest.approx((mean / factor, mean * factor), rel=0.02)
    alone = risk.std() / math.sqrt(risk.size) / mean
    assert math.log(found.high / found.low) > 2 * 1.96 * alone


def test_violations_of_which_none_hits_anything_bound_no_harm(folder):
    """None in a few has an upper end, and at which speed it would be nobody knows."""
    one = hazard(runs=("cut-in",), rule="safe-distance", extra=SAMPLING, harm=CURVE)
    found = judged(folder, one, accepted=1e3)
    arrays = read_arrays(folder / "cut-in" / "rollouts.npz")
    broken = arrays["broken.safe-distance"]
    assert np.any(broken)
    assert not np.any(arrays["impact_speed_mps"][broken] > 0.0)
    assert found.outcome == "not known"
    assert "none of its violations hits anything" in found.hazards[0].unknown


def test_the_impact_speed_of_a_single_violation_is_not_taken_as_exact(folder):
    """Of a seed that has one: its spread would be 0, and P(harm) known for certain."""
    path = folder / "counted" / "rollouts.npz"
    violated = read_arrays(path)["violated"]
    assert np.count_nonzero(violated) == 16
    for count, outcome in ((1, "not known"), (5, "met"), (16, "met")):
        speed = np.linspace(5.0, 9.0, count)
        hits = np.ones(count, dtype=np.bool_)
        speeds = impact_speeds(speed, hit=hits, weight=np.ones(count))
        assert speeds.independent == pytest.approx(count)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(risk_budget, "run_impact_speeds", lambda *_, **__: speeds)  # noqa: B023
            one = hazard(runs=("counted",), extra=SAMPLING, harm=CURVE)
            found = judged(folder, one, accepted=1e3)
        assert found.outcome == outcome
        assert any("of few violations" in text for text in found.cautions) == (count == 5)


def test_a_run_made_for_another_rate_of_encounters_is_named(folder, tmp_path):
    run = make_run(tmp_path / "run", replace(COUNTED, encounters_per_hour=900.0))
    one = judged(tmp_path, hazard(runs=(run.name,), extra=SAMPLING))
    assert any("made for 900 encounters an hour" in text for text in one.cautions)


def test_the_sum_of_hazards_is_that_of_their_products(folder):
    one = judged(folder, hazard(), hazard(name="other", harm=EXACT), accepted=1.0)
    values = [12.0 * 1e-6 * 0.05, 12.0 * 1e-6]
    assert one.outcome == "met"
    assert one.risk.harm_per_hour.value == pytest.approx(math.fsum(values))


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ({"runs": ("nowhere",)}, "there is no such folder"),
        ({"runs": ("cut-in",)}, "rule: is missing: run"),
        ({"runs": ("cut-in",), "rule": "nonsense"}, "has no-collision, safe-distance, any"),
        ({"runs": ("counted",), "rule": "no-collision"}, "has any, or left out"),
    ],
)
def test_a_run_that_does_not_fit_is_refused(folder, named, words):
    with pytest.raises(InputError, match=words):
        judged(folder, hazard(**named))


def test_a_damaged_run_is_refused(folder, tmp_path):
    run = make_run(tmp_path / "run", replace(COUNTED, final_rollouts=20))
    (run / "rollouts.npz").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(InputError):
        judged(tmp_path, hazard(runs=("run",)))
