"""Several rules in one run: each against an enumeration, and wherever they are told."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from pemviz.cli.main import main
from pemviz.config import ExperimentConfig, Rule
from pemviz.config.rule_words import GateLimits, read_limits
from pemviz.config.toml_files import config_from_table, config_text, load_config
from pemviz.errors import ConfigError
from pemviz.recording.text import answer_text
from pemviz.reports.case_runs import CaseRun
from pemviz.reports.gate import decide_limits
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.safety_case import safety_case_page
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.runs.reading import read_result
from pemviz.runs.result_file import result_document, result_from_document
from pemviz.runs.rollout_files import load_rollouts, stage_files
from pemviz.runs.run_folder import create_run_folder, record
from pemviz.sampling.rollouts.simulate import replay
from pemviz.types import outcome_log_likelihood
from tests.lattice_walk import ToyPem, ToySimulator

STATES = 13
WALK, PEM = ToySimulator(initial_gap=4, largest_gap=6, states=STATES), ToyPem(at_zero=1.6)
RULES = {
    "touch": f"always[0,{STATES - 1}] (gap >= 0.5)",
    "stay": f"eventually[6,{STATES - 1}] (gap >= 3.5)",
    "deep": f"always[0,{STATES - 1}] (gap >= -2.5)",
}
"""About 1.4e-2, 9e-3 and 4e-5; ``deep`` implies ``touch``."""
CONFIG = ExperimentConfig(
    method="mixture",
    stages=5,
    rollouts=150,
    final_rollouts=300,
    epochs=60,
    seed=3,
    measured_memory=False,
).with_rules(RULES)


def truth_by_enumeration(config):
    """Probability that each rule is broken, and any, over all 2^12 chains of outcomes."""
    outcomes = np.array(list(itertools.product([False, True], repeat=STATES - 1)))
    signals = replay(simulator=WALK, detected=outcomes)
    logit = PEM.logit(WALK.salient(signals))[:, :-1]
    chance = np.exp(outcome_log_likelihood(logit, outcomes).sum(axis=1))
    gap = signals["gap"]
    broken = {
        "touch": (gap <= 0).any(axis=1),
        "stay": (gap[:, 6:] < 4).all(axis=1),
        "deep": (gap <= -3).any(axis=1),
    }
    anything = np.any([broken[rule.name] for rule in config.rules], axis=0)
    return {name: chance[rows].sum() for name, rows in broken.items()}, chance[anything].sum()


def experiment_of(config):
    return build_experiment(config, simulator=WALK, pem=PEM, twin=WALK)


@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("mixture", {}),
        ("naive", {"final_rollouts": 8_000}),
        ("monte-carlo", {"final_rollouts": 8_000}),
        ("splitting", {"stages": 12, "rollouts": 200}),
        ("subset", {"stages": 12, "rollouts": 400}),
    ],
)
def test_every_rule_is_answered_by_one_run(method, changes):
    """z-tests at 4.5 standard errors (false alarm 7e-6 each); the seed is fixed."""
    result = run(experiment_of(replace(CONFIG, method=method, **changes)))
    truths, anything = truth_by_enumeration(CONFIG)
    answers = {rule.name: rule.estimate for rule in result.rules}
    assert list(answers) == list(RULES)
    assert abs(result.estimate.probability - anything) < 4.5 * result.estimate.std_error
    for name in ("touch", "stay"):
        assert abs(answers[name].probability - truths[name]) < 4.5 * answers[name].std_error
        assert answers[name].std_error < 0.5 * truths[name]
    assert answers["touch"].probability != answers["stay"].probability
    if method == "mixture":  # the others hardly meet 4e-5, and say so
        assert abs(answers["deep"].probability / truths["deep"] - 1.0) < 0.3
        assert answers["deep"].diagnostics == ()
    elif answers["deep"].probability:
        assert abs(answers["deep"].probability - truths["deep"]) < 20.0 * truths["deep"]
    else:
        assert {one.kind for one in answers["deep"].diagnostics} & {"no-failure", "died-out"}


def test_the_value_function_and_the_paper_s_algorithm_answer_rules_too():
    """Two rules on single states, which the value function needs."""
    config = replace(CONFIG, final_rollouts=2_000).with_rules(
        {"touch": RULES["touch"], "near": f"always[8,{STATES - 1}] (gap >= 1.5)"}
    )
    found = run(experiment_of(replace(config, method="zero-variance")))
    (touch, near) = (rule.estimate for rule in found.rules)
    truths, _ = truth_by_enumeration(CONFIG)
    assert abs(touch.probability - truths["touch"]) < 4.5 * touch.std_error
    assert touch.probability < near.probability < found.estimate.probability
    adaptive = run(build_experiment(replace(config, method="adaptive", spec=config.spec)))
    assert [rule.name for rule in adaptive.rules] == ["touch", "near"]


def test_what_a_run_keeps_of_rules_comes_back(tmp_path):
    """Configuration, result, rollouts; a resumed run ends with the same answers."""
    config = replace(CONFIG, method="naive", final_rollouts=400)
    folder = create_run_folder(tmp_path, label="rules")
    result = record(experiment_of(config), folder)
    assert load_config(folder / "config.toml").rules == tuple(Rule(*r) for r in RULES.items())
    assert read_result(folder).rules == result.rules
    rollouts = load_rollouts(folder)
    columns = [rollouts[f"broken.{name}"] for name in RULES]
    np.testing.assert_array_equal(np.any(columns, axis=0), rollouts["violated"])
    worst = result.least_robust[0]
    assert worst.broken == tuple(n for n in RULES if rollouts[f"broken.{n}"][worst.rollout])
    ranked = read_result(folder).least_robust_by_rule
    assert ranked == result.least_robust_by_rule
    for name, formula in RULES.items():
        first = [one.rollout for one in ranked[name] if one.violated]
        assert first
        assert all(rollouts[f"broken.{name}"][rollout] for rollout in first)
        robustness = [one.robustness for one in ranked[name] if one.share is not None]
        assert robustness == sorted(robustness)
        alone = replace(config, rules=(), spec=formula)
        expected = run(experiment_of(alone)).least_robust
        assert [(one.rollout, one.robustness, one.share) for one in ranked[name]] == [
            (one.rollout, one.robustness, one.share) for one in expected
        ]

    stopped = create_run_folder(tmp_path, label="stopped")
    record(
        experiment_of(replace(config, repetitions=2)),
        stopped,
        should_stop=lambda: len(stage_files(stopped)) > 0,
    )
    again = record(experiment_of(replace(config, repetitions=2)), stopped)
    whole = run(experiment_of(replace(config, repetitions=2)))
    assert again.rules == whole.rules
    assert again.least_robust_by_rule == whole.least_robust_by_rule
    assert whole.rules[0].estimate.rollouts_simulated == 800


def test_rules_stand_on_every_page():
    result = run(experiment_of(replace(CONFIG, method="naive", final_rollouts=400)))
    document = json.loads(json.dumps(result_document(result)))
    assert result_from_document(document).rules == result.rules
    pages = (
        summary_markdown(result),
        answer_text(result, running=False),
        safety_case_page([CaseRun("run", result, None, {}, None)]),
    )
    for page in pages:
        for name in RULES:
            assert name in page
        assert "by itself" in page
    damaged = {**document, "rules": [{**document["rules"][0], "estimate": {}}]}
    with pytest.raises(ConfigError, match=r"rules\[0\]\.estimate"):
        result_from_document(damaged)


def test_a_gate_may_limit_single_rules():
    result = run(experiment_of(replace(CONFIG, method="monte-carlo", final_rollouts=4_000)))
    cases = [
        (GateLimits(), None, None),
        (GateLimits(0.5), "passed", 0.5),
        (GateLimits(None, {"touch": 0.1}), "passed", None),
        (GateLimits(0.5, {"touch": 1e-5, "stay": 0.5}), "tripped", 0.5),
        (GateLimits(None, {"touch": 0.1, "another": 0.1}), "undecided", None),
    ]
    for limits, outcome, limit in cases:
        decision = decide_limits(result, limits=limits)
        assert (None if decision is None else decision.outcome) == outcome
        if decision is not None:
            assert decision.limit == limit
    failed = decide_limits(replace(result, status="failed"), limits=GateLimits(None, {"touch": 1}))
    assert failed.exit_code == 3


def test_limits_are_read_and_refused():
    rules = CONFIG.rules
    assert read_limits([], rules=rules) == GateLimits()
    found = read_limits(["1e-9", "touch=0.5"], rules=rules)
    assert found == GateLimits(1e-9, {"touch": 0.5})
    assert read_limits(["0.1", "0.2"], rules=()) == GateLimits(0.2)
    for words, told in [
        (["x=0.1"], "must name one of the rules (touch, stay, deep)"),
        (["touch=2"], "above 0 and at most 1"),
        (["nan"], "above 0 and at most 1"),
        (["often"], "must be a number"),
    ]:
        with pytest.raises(ConfigError) as error:
            read_limits(words, rules=rules)
        assert told in str(error.value)
    with pytest.raises(ConfigError, match="there are none"):
        read_limits(["x=0.1"], rules=())
    assert read_limits(["0.1"], rules=(), bound="act-on") == GateLimits(0.1, bound="act-on")
    with pytest.raises(ConfigError, match="fail-on = act-on: must be given with fail-above"):
        read_limits([], rules=(), bound="act-on")  # or a run without a gate would look like a pass


def test_rules_in_a_file_are_a_table(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text('seed = 1\n[rules]\nnear = "always[0,9] (gap >= 2)"\n', encoding="utf-8")
    config = load_config(path)
    assert config.rules == (Rule("near", "always[0,9] (gap >= 2)"),)
    assert config.spec == "(always[0,9] (gap >= 2))"
    (tmp_path / "again.toml").write_text(config_text(config), encoding="utf-8")
    assert load_config(tmp_path / "again.toml") == config
    assert "rules" not in config_text(ExperimentConfig())


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ({"rules": {"1st": "gap > 0"}}, "the name '1st'"),
        ({"rules": {"a": 3}}, "rules.a = 3"),
        ({"rules": ["gap > 0"]}, "must be a table"),
        ({"rules": {}}, "must name one rule at least"),
        ({"rules": {"a": "gap > 0"}, "spec": "gap > 1"}, "must be left out"),
        ({"rules": {f"r{i}": "gap > 0" for i in range(21)}}, "at most 20"),
    ],
)
def test_bad_rules_in_a_file_are_refused(table, told):
    with pytest.raises(ConfigError) as error:
        config_from_table(table).validate()
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--rule", "gap > 2"], "must be NAME=FORMULA"),
        (["--rule", "gap >= 2"], "the name 'gap >' must be a letter"),
        (["--rule", "a=gap > 2", "--rule", "a=gap > 3"], "another rule has this name"),
        (["--rule", "a=gap > 2", "--spec", "gap > 3"], "must be left out"),
        (["--rule", "a=always[0,999] (gap > 2)"], "rules.a = 'always[0,999]"),
        (["--rule", "a=speed > 2"], "rules.a = 'speed > 2'"),
        (["--rule", "a=gap > 2", "--fail-above", "b=0.1"], "must name one of the rules (a)"),
    ],
)
def test_bad_rules_on_the_command_line_are_one_line(words, told, tmp_path, capsys):
    assert main(["record", "--out", str(tmp_path), *words]) == 2
    printed = capsys.readouterr().err
    assert told in printed
    assert printed.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
