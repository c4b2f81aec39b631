"""The braking scenario with a tracker between perception and controller."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

from pemviz.cli.record_arguments import parse
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import config_from_table, config_table
from pemviz.errors import ConfigError
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.zero_variance.reference import exact_log_probability
from pemviz.simulators.braking.highway_env_scenario import BrakingEnv
from pemviz.simulators.braking.scenario import BrakingFeatures
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import outcome_log_likelihood

COARSE = ScenarioConfig(dt_s=0.25, states=14)
SPEC = "always[0,13] (gap >= 4.0)"
KALMAN = "2/3,coast=0.5,filter=kalman"


def experiment_of(tracker, **settings):
    scenario = replace(COARSE, tracker=tracker)
    settings = {"method": "zero-variance", "spec": SPEC, "plan": False} | settings
    return build_experiment(ExperimentConfig(scenario=scenario, measured_memory=False, **settings))


def by_chains(experiment):
    """All 8192 chains of outcomes, rolled out and summed."""
    simulator = VectorizedSimulator(experiment.config.scenario)
    steps = simulator.states - 1
    detected = np.array(list(itertools.product((False, True), repeat=steps)))
    signals = replay(simulator=simulator, detected=detected)
    logit = experiment.pem.logit(simulator.salient(signals))[:, :-1]
    log_p = outcome_log_likelihood(logit, detected).sum(axis=1)
    return float(np.exp(logsumexp(log_p[signals["gap"].min(axis=1) < 4.0])))


def exact(tracker):
    experiment = experiment_of(tracker)
    return math.exp(exact_log_probability(experiment.problem, twin=experiment.twin))


@pytest.mark.parametrize("tracker", ["2/3", "2/3,coast=0.5", "1/2,filter=alpha-beta", KALMAN])
def test_the_recursion_is_exact(tracker):
    assert exact(tracker) == pytest.approx(by_chains(experiment_of(tracker)), rel=1e-9)


def test_confirming_makes_it_less_safe_and_coasting_safer():
    """What is told after 2 of 3 was detected before; a track that coasts brakes on all the same."""
    none, confirming = exact("none"), exact("2/3")
    assert exact("1/1") == pytest.approx(none, rel=1e-9)
    assert confirming > none
    assert exact("2/3,coast=0.5") < confirming


@pytest.mark.parametrize("method", ["mixture", "splitting", "subset"])
def test_methods_agree_with_all_chains(method):
    """Five standard errors; seeds are fixed."""
    settings = {"method": method, "rollouts": 200, "stages": 5, "final_rollouts": 500, "seed": 1}
    if method == "subset":  # whose chains move on slowly over equal scores
        settings |= {"rollouts": 1_000, "stages": 10}
    experiment = experiment_of("2/3,coast=0.25", **settings)
    found = run(experiment).estimate
    assert abs(found.probability - by_chains(experiment)) < 5 * found.std_error


def test_a_track_that_coasts_is_learned_with_few_rollouts():
    """The recursion over all states: 1.87e-10, of misses once the last hit lies beyond 10 m.

    Five standard errors, which are below a tenth; the seed is fixed.
    """
    scenario = replace(COARSE, dt_s=0.1, states=50, tracker="2/3,coast=0.5")
    settings = {"scenario": scenario, "spec": "always[0,49] (gap >= 2.0)", "plan": False}
    config = ExperimentConfig(**settings, method="zero-variance", measured_memory=False)
    by_recursion = build_experiment(config)
    truth = math.exp(exact_log_probability(by_recursion.problem, twin=by_recursion.twin))
    budget = {"rollouts": 50, "stages": 6, "final_rollouts": 200, "seed": 1}
    found = run(build_experiment(replace(config, method="mixture", **budget))).estimate
    assert abs(found.probability - truth) < 5 * found.std_error < 0.5 * truth
    assert not found.warnings


@pytest.mark.parametrize(
    "tracker", ["2/3", "1/1", "2/3,coast=0.75", "1/2,filter=alpha-beta", KALMAN]
)
def test_proposals_see_where_an_outcome_decides_at_once(tracker):
    """Where a step after a hit and one after a miss lead to different speeds."""
    scenario = replace(COARSE, tracker=tracker, lead_deceleration_mps2=2.0)
    simulator, features = VectorizedSimulator(scenario), BrakingFeatures(scenario)
    generator, seen = np.random.default_rng(7), set()
    states = simulator.initial(count=400)
    for _ in range(scenario.states - 1):
        hit, miss = (simulator.step(states, np.full(400, o)) for o in (True, False))
        differs = hit.signals["ego_speed"] != miss.signals["ego_speed"]
        moving = states.signals["ego_speed"] > 0.0
        decides = features.values(states)[:, 3]
        np.testing.assert_array_equal(decides[moving], differs[moving])
        seen |= set(decides[moving].tolist())
        states = simulator.step(states, generator.random(400) < 0.6)
    assert seen == {0.0, 1.0}


def test_the_environment_alone_tracks_too():
    scenario = replace(COARSE, tracker=KALMAN)
    detected = np.random.default_rng(4).random((3, COARSE.states - 1)) < 0.7
    expected = replay(simulator=VectorizedSimulator(scenario), detected=detected)["gap"]
    environment = BrakingEnv(scenario)
    for row, outcomes in enumerate(detected):
        environment.reset()
        gaps = [environment.step(int(outcome))[0][0] for outcome in outcomes]
        np.testing.assert_allclose(gaps, expected[row, 1:], rtol=0, atol=1e-9)


def test_the_option_is_kept_with_the_configuration():
    config = parse(["--tracker", KALMAN, "--preset", "town01"]).experiment
    assert config.scenario.tracker == KALMAN
    assert config_from_table(config_table(config)) == config
    assert parse([]).experiment.scenario.tracker == "none"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "tracker = '': must be none, or M/N for M hits of N outcomes, then options"),
        ("2of3", "tracker = '2of3': must be none, or M/N"),
        ("4/3", "4 hits of 3 outcomes: must be no more"),
        ("0/3", "tracker: hits = 0: must be a whole number, at least 1 and at most 30"),
        ("2/x", "tracker: window = 'x': must be a whole number, at least 1 and at most 30"),
        ("2/3,0.5", "'0.5' must be NAME=VALUE, each once, of coast, filter, alpha"),
        ("2/3,coast=-1", "tracker: coast = -1.0: must be a number, at least 0"),
        ("2/3,coast=1,coast=2", "'coast=2' must be NAME=VALUE, each once"),
        ("2/3,filter=ekf", "tracker: filter = 'ekf': must be one of none, alpha-beta, kalman"),
        ("2/3,alpha=0.5", "alpha is no option of filter none"),
        ("2/3,filter=alpha-beta,alpha=0.9,beta=2.5", "tracker: beta = 2.5: must be below 2.2"),
        ("2/3,filter=kalman,position-sd=0", "tracker: position-sd = 0.0: must be a number, above"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(text, words):
    with pytest.raises(ConfigError) as raised:
        parse(["--tracker", text])
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)
