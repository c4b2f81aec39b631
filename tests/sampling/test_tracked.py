"""A tracker in the state: every method sees through it, against all chains of outcomes."""

import math

import numpy as np
import pytest
from scipy.special import expit

import pemviz
from pemviz import Tracker
from pemviz.sampling.zero_variance.reference import exact_log_probability
from tests.lattice_walk import ToyPem, ToySimulator
from tests.slot_toys import CAMERA, TwoCars

WALK, PEM = ToySimulator(initial_gap=4, states=13), ToyPem(at_zero=2.5)
SPEC = "always[0,12] (gap >= 0.5)"


def tracker_of(hits, window, coast_steps, dt_s=WALK.dt_s):
    return Tracker(dt_s=dt_s, hits=hits, window=window, coast_s=coast_steps * dt_s)


TRACKERS = {
    "first hit": (1, 1, 0),
    "2 of 3": (2, 3, 0),
    "2 of 3, coasting": (2, 3, 2),
    "3 of 5, coasting": (3, 5, 1),
}


def experiment_of(simulator, *, pem=PEM, spec=SPEC, **settings):
    config = pemviz.ExperimentConfig(spec=spec, plan=False, measured_memory=False, **settings)
    return pemviz.build_experiment(config, simulator=simulator, pem=pem, twin=simulator)


def exact(simulator, **settings):
    experiment = experiment_of(simulator, method="zero-variance", **settings)
    return math.exp(exact_log_probability(experiment.problem, twin=experiment.twin))


def tracked_after(chain, hits, window, coast_steps):
    """Whether there is a confirmed track after a chain of outcomes, gone through from its start."""
    since, confirmed = [], False
    for detected in chain:
        since.append(detected)
        if confirmed and not any(since[-coast_steps - 1 :]):
            since, confirmed = [], False
        elif sum(since[-window:]) >= hits:
            confirmed = True
    return confirmed


def by_chains(rule, *, start=4, steps=12, largest=8, pem=PEM, rho=0.0, chain=()):
    """The sum over all chains of outcomes that bring the walk to 0 of their probabilities."""
    if start == 0 or steps == 0:
        return float(start == 0)
    missed = float(expit(-pem.logit(np.array([float(start)]))))
    if chain:
        missed += (float(not chain[-1]) - missed) * rho
    total = 0.0
    for detected, chance in ((False, missed), (True, 1.0 - missed)):
        away = tracked_after((*chain, detected), *rule)
        after = {"start": min(start + 1, largest) if away else start - 1, "steps": steps - 1}
        options = {"largest": largest, "pem": pem, "rho": rho, "chain": (*chain, detected)}
        total += chance * by_chains(rule, **after, **options)
    return total


@pytest.mark.parametrize("rule", TRACKERS.values(), ids=TRACKERS)
def test_the_recursion_is_exact(rule):
    assert exact(pemviz.tracked(WALK, tracker_of(*rule))) == pytest.approx(
        by_chains(rule), rel=1e-11
    )


def test_it_is_exact_with_a_memory_of_misses_too():
    rule = TRACKERS["2 of 3, coasting"]
    found = exact(pemviz.tracked(WALK, tracker_of(*rule)), memory_s=1.5)
    assert found == pytest.approx(by_chains(rule, rho=math.exp(-1.0 / 1.5)), rel=1e-11)


def test_confirming_makes_it_less_safe_and_coasting_safer():
    """In every chain: what is told after 2 of 3 was detected, and coasting only adds to it."""
    found = {
        name: exact(pemviz.tracked(WALK, tracker_of(*rule))) for name, rule in TRACKERS.items()
    }
    assert found["first hit"] == pytest.approx(exact(WALK), rel=1e-12)
    assert found["2 of 3"] > 2 * found["first hit"]
    assert found["2 of 3, coasting"] < 0.5 * found["2 of 3"]


@pytest.mark.parametrize("rule", [TRACKERS["2 of 3"], TRACKERS["3 of 5, coasting"]])
def test_each_slot_has_a_track_of_its_own(rule):
    """Two cars that do not concern each other: 1 - (1 - a) (1 - b)."""
    cars = TwoCars(starts=(4, 5), in_view=12, states=11)
    found = exact(
        pemviz.tracked(cars, tracker_of(*rule, dt_s=cars.dt_s)),
        pem=CAMERA, spec="always[0,10] (gap_a >= 0.5 and gap_b >= 0.5)",
    )  # fmt: skip
    either = [by_chains(rule, start=s, steps=10, largest=12, pem=CAMERA) for s in cars.starts]
    assert found == pytest.approx(1 - math.prod(1 - one for one in either), rel=1e-10)


@pytest.mark.parametrize("method", ["mixture", "splitting", "subset", "monte-carlo"])
def test_methods_agree_with_all_chains(method):
    """Five standard errors, a false alarm in 1e6; seeds are fixed."""
    rule = TRACKERS["2 of 3, coasting"]
    settings = {"rollouts": 200, "stages": 6} if method != "monte-carlo" else {}
    settings |= {"final_rollouts": 40_000 if method == "monte-carlo" else 1_000}
    simulator = pemviz.tracked(WALK, tracker_of(*rule))
    found = pemviz.run(experiment_of(simulator, method=method, seed=1, **settings)).estimate
    assert abs(found.probability - by_chains(rule)) < 5 * found.std_error
    assert found.failures > 20


def test_proposals_look_at_tracks():
    simulator = pemviz.tracked(WALK, tracker_of(2, 3, 2))
    experiment = experiment_of(simulator, method="mixture")
    states = experiment.problem.simulator.initial(count=2)
    for hit in ((True, False), (True, True), (False, False)):
        states = experiment.problem.simulator.step(states, np.array(hit))
    values = experiment.features.values(states)
    np.testing.assert_array_equal(values[:, -2:], [[2.0, 1.0], [1.0, 1.0]])


@pytest.mark.parametrize(
    ("tracker", "words"),
    [
        (Tracker(dt_s=0.5), "dt_s = 1, and its tracker's is 0.5"),
        (Tracker(dt_s=1.0, axes=1), "hands on no positions: must be a tracker with axes = 0"),
    ],
)
def test_trackers_that_do_not_fit_are_refused(tracker, words):
    with pytest.raises(pemviz.ConfigError, match=words):
        experiment_of(pemviz.tracked(WALK, tracker), method="mixture")


def test_a_simulator_that_forgets_its_tracker_is_refused():
    class Forgetful(ToySimulator):
        tracker = Tracker(dt_s=1.0, coast_s=1.0)

    with pytest.raises(pemviz.ConfigError, match="lacks track_confirmed, track_misses, track_win"):
        experiment_of(Forgetful(), method="mixture")
