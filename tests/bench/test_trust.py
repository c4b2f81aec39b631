"""The study of trust: its truths, its arithmetic, and a small study from end to end."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.accuracy import Outcome, summarise
from benchmarks.trust_cases import BRAKING, SPECIFICATIONS, TrustCase, trust_cases
from benchmarks.trust_report import case_lines, report_lines
from benchmarks.trust_study import RUNS, TrustStudy, chosen, run_trust
from benchmarks.trust_systems import LinearLogit, TwoWayWalk
from benchmarks.trust_truth import (
    VIOLATED,
    always,
    always_eventually,
    both,
    eventually,
    eventually_always,
    exact_probability,
    response,
    until,
)
from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.pem import as_pem
from pemviz.sampling.rollouts.simulate import replay
from tests.conftest import shared
from tests.lattice_walk import ToyPem, ToySimulator, toy_probability_by_enumeration

STATES = 12


def gap_of(walk, outcomes):
    return replay(simulator=walk, detected=outcomes)


@pytest.mark.parametrize(
    ("spec", "automaton"),
    [
        ("always[2,11] (gap >= 3)", always(lambda s: s["gap"] >= 3, 2, 11)),
        (
            "always[0,8] (gap >= 2) and always[8,8] (gap < 3.5 or gap > 5.5)",
            both(
                always(lambda s: s["gap"] >= 2, 0, 8),
                always(lambda s: (s["gap"] < 3.5) | (s["gap"] > 5.5), 8, 8),
            ),
        ),
        (
            "(gap >= 3) until[4,9] (gap >= 7)",
            until(lambda s: s["gap"] >= 3, lambda s: s["gap"] >= 7, 4, 9),
        ),
        ("eventually[3,8] (gap >= 8)", eventually(lambda s: s["gap"] >= 8, 3, 8)),
        (
            "always[1,7] (eventually[0,3] (gap >= 6))",
            always_eventually(lambda s: s["gap"] >= 6, 1, 7, 3),
        ),
        (
            "eventually[1,7] (always[0,3] (gap >= 6))",
            eventually_always(lambda s: s["gap"] >= 6, 1, 7, 3),
        ),
        (
            "always[0,8] (gap < 4.5 -> eventually[0,3] (gap >= 6))",
            response(lambda s: s["gap"] < 4.5, lambda s: s["gap"] >= 6, 8, 3),
        ),
    ],
)
def test_an_automaton_says_what_the_formula_says_on_every_rollout(spec, automaton):
    """All 2^11 rollouts of a walk, and their likelihoods added up."""
    walk, model = TwoWayWalk(states=STATES), LinearLogit(1.0, -0.3)
    case = TrustCase(
        name="x", config=ExperimentConfig(spec=spec), truth=1.0, system=walk, model=model
    )
    problem = case.experiment(replace(case.config, method="monte-carlo")).problem
    bits = np.arange(2 ** (STATES - 1))
    outcomes = (bits[:, None] >> np.arange(STATES - 1)) & 1 == 1
    signals = gap_of(walk, outcomes)
    reading = np.zeros(bits.size, dtype=np.int64)
    for step in range(STATES):
        at_step = {name: values[:, step] for name, values in signals.items()}
        reading = np.where(reading >= 0, automaton(step, at_step, reading), reading)
    violated = problem.robustness(signals) < 0.0  # classical: that is the verdict
    np.testing.assert_array_equal(reading == VIOLATED, violated)
    assert 0 < violated.sum() < bits.size
    logit = model.logit(walk.salient(signals))[:, :-1]
    log_p = -np.logaddexp(0.0, np.where(outcomes, -logit, logit)).sum(axis=1)
    expected = float(np.exp(log_p[violated]).sum())
    found = exact_probability(problem.simulator, problem.pem, automaton)
    assert found == pytest.approx(expected, rel=1e-12)


def test_the_recursion_agrees_with_an_enumeration_of_another_walk():
    walk, model = ToySimulator(states=11), ToyPem()
    found = exact_probability(walk, as_pem(model), always(lambda s: s["gap"] > 0, 0, 10))
    assert found == pytest.approx(toy_probability_by_enumeration(walk, model), rel=1e-12)


@pytest.mark.parametrize(
    "case", [c for c in trust_cases() if c.name.startswith("walk")], ids=lambda case: case.name
)
def test_truths_of_the_walks_are_recomputed(case):
    assert case.recomputed() == pytest.approx(case.truth, rel=1e-9)


@pytest.mark.parametrize("name", ["paper, ml-nn: always, 5 m", "paper, ml-nn: two sides, speed"])
def test_truths_of_the_braking_scenario_are_recomputed(name):
    (case,) = chosen([name], trust_cases())
    assert case.recomputed() == pytest.approx(case.truth, rel=1e-9)


def test_counted_truths_are_within_their_errors():
    """17,676 of 10^7 and 113,622 of 10^7 by plain Monte Carlo: 4 standard errors, 6e-5 each."""
    shared("authors_pem/pem_ml_nn.safetensors")
    for name, count in (("two sides, band", 17_676), ("two sides, early", 113_622)):
        (case,) = chosen([f"town01, authors: {name}"], trust_cases())
        assert abs(count - 1e7 * case.truth) < 4.0 * math.sqrt(1e7 * case.truth)


def test_the_cases_are_what_the_study_asks_for():
    shared("authors_pem/pem_ml_nn.safetensors")
    cases = trust_cases()
    assert len(cases) >= 20
    assert len({case.name for case in cases}) == len(cases)
    assert min(case.truth for case in cases) < 1e-24
    assert max(case.truth for case in cases) > 0.9
    assert {case.config.scenario.initial_speed_kmh for case in cases} == {70.0, 30.0}
    assert {specification for _, _, specification, _ in BRAKING} <= set(SPECIFICATIONS)
    assert len(case_lines(cases)) == 2 + len(cases)


def outcome(ratio, *, covers=True, warned=False, interval=None):
    return Outcome(
        ratio=ratio, covers=covers, rollouts=10, wall_s=1.0, warned=warned, interval=interval
    )


def test_how_wide_intervals_would_have_to_be():
    """Of z / 1.96 with z normal, 95 % are below 1; half as wide a factor needs twice that."""
    # 4.5 standard errors of a 95 % quantile of 4,000: false alarm 7e-6
    z = np.random.default_rng(3).normal(size=4000)
    ends = [(math.exp(0.1 * x - 0.196), math.exp(0.1 * x + 0.196)) for x in z]
    outcomes = [outcome(math.exp(0.1 * x), interval=end) for x, end in zip(z, ends, strict=True)]
    row = summarise(outcomes, scenario="x", method="mixture", truth=1e-3)
    assert row.unwarned_width == pytest.approx(1.0, abs=0.07)
    assert outcome(2.0, interval=(1.0, 4.0)).width_needed == pytest.approx(1.0)
    assert outcome(0.5, interval=(0.1, 4.0)).width_needed == pytest.approx(1.0 / 3.0)
    assert outcome(0.5, interval=(0.0, 4.0)).width_needed is None
    assert summarise([outcome(1.0)], scenario="x", method="m", truth=0.1).unwarned_width is None


def test_what_misleads_is_far_off_and_does_not_warn():
    outcomes = [
        outcome(0.49), outcome(2.01, covers=False), outcome(1.0), outcome(0.5, covers=False),
        outcome(9.0, warned=True, covers=False),
    ]  # fmt: skip
    row = summarise(outcomes, scenario="x", method="mixture", truth=1e-3)
    assert row.misleading == pytest.approx(2 / 5)
    assert row.warned == pytest.approx(1 / 5)
    assert row.unwarned_coverage == pytest.approx(2 / 4)
    assert row.coverage == pytest.approx(2 / 5)
    none = summarise([outcome(9.0, warned=True)], scenario="x", method="mixture", truth=1e-3)
    assert none.unwarned_coverage is None


def test_who_is_close_and_warns_all_the_same():
    """Four are within 10 % of the truth, of which one warns; whether 1.2 does is no matter."""
    outcomes = [
        outcome(1.0),
        outcome(1.09, warned=True),
        outcome(0.91),
        outcome(0.95, covers=False),
    ]
    others = [outcome(1.2, warned=True), outcome(0.0, warned=True)]
    row = summarise([*outcomes, *others], scenario="x", method="mixture", truth=1e-3)
    assert row.close_warned == pytest.approx(1 / 4)
    assert summarise(others, scenario="x", method="mixture", truth=1e-3).close_warned is None


def test_a_small_study_that_is_interrupted_goes_on(tmp_path):
    """Its runs are kept one by one; what is there is not run again, what is torn is."""
    study = TrustStudy(
        cases=("walk: 0.9", "walk: until"),
        methods=("zero-variance", "mixture"),
        seeds=2,
        rollouts=240,
        processes=1,
        out=tmp_path,
    )
    whole = run_trust(study)
    assert [(row.scenario, row.method) for row in whole.rows] == [
        ("walk: 0.9", "zero-variance"), ("walk: 0.9", "mixture"), ("walk: until", "mixture"),
        ("all", "zero-variance"), ("all", "mixture"),
    ]  # fmt: skip
    assert list(whole.refused) == [("walk: until", "zero-variance")]
    assert whole.rows[0].relative_rmse < 0.1
    lines = (tmp_path / RUNS).read_text(encoding="utf-8").splitlines()
    assert len(lines) == 6
    marked = {**json.loads(lines[0]), "ratio": 77.0, "diagnostics": ["wide-interval"]}
    (tmp_path / RUNS).write_text("\n".join([json.dumps(marked), *lines[1:5], lines[5][:40]]) + "\n")
    again = run_trust(study)
    assert again.rows[0].relative_rmse > 50.0
    assert len((tmp_path / RUNS).read_text(encoding="utf-8").splitlines()) == 7
    assert {one.method for one in again.verdicts} == {"zero-variance", "mixture"}
    assert not again.verdicts[0].met
    assert "1 of them say" in again.verdicts[0].figure
    assert any(line.startswith("MISSED: zero-variance") for line in report_lines(again))
    assert json.loads((tmp_path / "trust.json").read_text(encoding="utf-8"))["schema"] == 1


def test_the_command_lists_its_cases(capsys):
    assert main(["trust", "--list", "--cases", "walk", "drone"]) == 0
    printed = capsys.readouterr().out
    assert "two modes" in printed
    assert "plain Monte Carlo" in printed


def test_what_cannot_be_measured_is_refused(tmp_path):
    with pytest.raises(InputError, match="cases = 'moon'"):
        run_trust(TrustStudy(cases=("moon",), out=tmp_path))
    with pytest.raises(InputError, match="seeds"):
        run_trust(TrustStudy(seeds=0, out=tmp_path))
