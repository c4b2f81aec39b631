"""The braking scenario on measured distances, against plain loops, and its exact answers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import pemviz
from pemviz.config import ScenarioConfig
from pemviz.config.toml_files import load_preset
from pemviz.errors import ConfigError, InputError
from pemviz.pem import NoiseMemory, constant_errors, load_position_errors, save_position_errors
from pemviz.pem.judging.position_error_report import straight_ahead
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.braking.highway import HighwaySimulator
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from tests.simulators.reference import reference_rollout
from tests.toy import MissCounter, constant_pem

PAPER = ScenarioConfig()
SHIPPED = load_position_errors("pointpillars")
back_ends = pytest.mark.parametrize("back_end", [VectorizedSimulator, HighwaySimulator])


def drawn(count, *, seed=1, config=PAPER):
    random = np.random.default_rng(seed)
    steps = config.states - 1
    return {
        "detected": random.random((count, steps)) < 0.7,
        "start": random.standard_normal((count, 1)),
        "noise": random.standard_normal((count, steps, 1)),
    }


@back_ends
def test_no_spread_gives_the_answer_without_errors_to_the_last_bit(back_end):
    draws = drawn(6)
    exact = replay(simulator=back_end(PAPER), detected=draws["detected"])
    errors = constant_errors(memory=NoiseMemory(lasting_share=0.5, tau_s=0.2))
    measured = replay(simulator=back_end(PAPER, errors), **draws)
    for name, values in exact.items():
        np.testing.assert_array_equal(measured[name], values)


@back_ends
@pytest.mark.parametrize("tracker", ["none", "2/3", "2/4,coast=0.1,filter=kalman"])
def test_the_rule_acts_on_the_measured_gap_and_a_tracker_filters_it(back_end, tracker):
    """A plain loop finds the noise and the error of each step; the reference loop drives."""
    config = replace(PAPER, tracker=tracker)
    draws, memory = drawn(5, seed=3), SHIPPED.range_memory
    simulator = back_end(config, SHIPPED)
    passed = replay(simulator=simulator, **draws)
    exact = replay(simulator=back_end(config), detected=draws["detected"])
    assert np.abs(passed[GAP] - exact[GAP]).max() > 0.1  # errors matter
    rho, share = np.exp(-PAPER.dt_s / memory.tau_s), memory.lasting_share
    for row in range(5):
        moving, noises = 0.0, []
        for step, fresh in enumerate(draws["noise"][row, :, 0]):
            moving = fresh if step == 0 else rho * moving + np.sqrt(1.0 - rho**2) * fresh
            noises.append(np.sqrt(share) * draws["start"][row, 0] + np.sqrt(1.0 - share) * moving)

        def measure(step, gap_m, noises=noises):
            place = straight_ahead(gap_m + PAPER.lead_length_m / 2)
            return gap_m + SHIPPED.error(place, np.array([[noises[step], 0.0]]))[0, 0]

        seen = draws["detected"][row].tolist()
        expected = reference_rollout(config, seen, simulator.tracker, measure)
        for name in (GAP, EGO_SPEED, LEAD_SPEED):
            np.testing.assert_allclose(passed[name][row], expected[name], rtol=0, atol=1e-9)


def least_gap(error_m):
    """Of a rollout in which all is detected and measured with the same error throughout."""
    config = replace(PAPER, emergency_gap_m=PAPER.emergency_gap_m - error_m)
    return min(reference_rollout(config, [True] * (PAPER.states - 1))["gap"])


def critical_error():
    """The least error that lasts and violates, by bisection over the plain loop."""
    low, high = 0.0, 9.0
    assert least_gap(low) >= 2.0 > least_gap(high)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if least_gap(middle) >= 2.0 else (low, middle)
    return high


def test_an_error_that_lasts_violates_where_it_is_large_enough():
    """Gaussian, for the whole rollout, perfect detector: P(violation) = P(error > critical)."""
    sd_m, critical_m = 2.0, critical_error()
    errors = constant_errors(range_sd_m=sd_m, memory=NoiseMemory(lasting_share=1.0))
    count = 4000
    draws = drawn(count, seed=4)
    draws["detected"] = np.ones_like(draws["detected"])
    passed = replay(simulator=VectorizedSimulator(PAPER, errors), **draws)
    violated = passed[GAP].min(axis=1) < 2.0
    np.testing.assert_array_equal(violated, sd_m * draws["start"][:, 0] > critical_m)
    probability = stats.norm.sf(critical_m / sd_m)
    assert 0.02 < probability < 0.5
    # five standard errors: one run in two million fails
    tolerance = 5.0 * np.sqrt(probability / count)
    assert violated.mean() == pytest.approx(probability, abs=tolerance)


def test_a_rare_error_is_found_with_its_exact_probability(tmp_path):
    """P(a Gaussian is 6 deviations up) = 9.9e-10; four standard errors, one run in 16,000 fails."""
    errors = tmp_path / "errors.safetensors"
    save_position_errors(
        constant_errors(range_sd_m=critical_error() / 6.0, memory=NoiseMemory(lasting_share=1.0)),
        errors,
    )
    config = small("mixture", stages=6, rollouts=60, final_rollouts=300, seed=1)
    perfect = constant_pem(detection_probability=1.0 - 1e-13)
    experiment = pemviz.build_experiment(replace(config, position_errors=str(errors)), pem=perfect)
    estimate = pemviz.run(experiment).estimate
    assert estimate is not None
    assert estimate.std_error is not None
    assert estimate.std_error < 0.2 * estimate.probability
    tolerance = 4.0 * estimate.std_error
    assert estimate.probability == pytest.approx(stats.norm.sf(6.0), rel=0, abs=tolerance)


def small(method, **changes):
    config = replace(
        load_preset("paper"), method=method, rollouts=200, final_rollouts=200, plan=False,
        position_errors="pointpillars", pem="lr",
    )  # fmt: skip
    return replace(config, **changes)


def test_a_run_measures_with_errors_tells_so_and_is_replayed():
    config = small("monte-carlo")
    worst = pemviz.LeastRobust()
    experiment = pemviz.build_experiment(config)
    result = pemviz.run(experiment, observers=[worst])
    assert result.position_errors is not None
    assert result.position_errors.digest == SHIPPED.digest
    assert any("off as position errors pointpillars say" in each for each in result.assumptions)
    assert "measured distance: with errors of pointpillars, from" in pemviz.summary_text(result)
    rollout = worst.rollout
    assert rollout is not None
    again = replay(
        simulator=VectorizedSimulator(config.scenario, SHIPPED),
        detected=rollout.detected[None],
        start=rollout.start[None],
        noise=rollout.noise[None],
    )
    np.testing.assert_array_equal(again[GAP][0], rollout.signals[GAP])


def test_gaps_beyond_agms_bounds_count_as_the_bound_where_errors_may_lead_there():
    """Without latents and a tracker the two extreme rollouts stay within; no value is cut."""
    config = replace(small("monte-carlo"), metric="agm", spec="always[0,0] (gap >= 2.0)")
    beyond = {name: np.full((1, PAPER.states), 10.0) for name in (GAP, EGO_SPEED, LEAD_SPEED)}
    beyond[GAP][:] = 25.2
    experiment = pemviz.build_experiment(config)
    assert experiment.problem.robustness(beyond).tolist() == pytest.approx([(25.0 - 2.0) / 50.0])
    for scenario in (PAPER, replace(PAPER, tracker="1/2,coast=0.2")):
        exact = replace(config, position_errors=None, scenario=scenario)
        problem = pemviz.build_experiment(exact).problem
        if scenario is PAPER:
            with pytest.raises(InputError, match="declared bounds"):
                problem.robustness(beyond)
        else:
            assert problem.robustness(beyond).tolist() == pytest.approx([0.46])


def test_detections_matter_where_the_measured_gap_may_be_small():
    experiment = pemviz.build_experiment(small("monte-carlo"))
    states = experiment.back_end.simulator.initial(count=3)
    at = replace(states, signals={**states.signals, GAP: np.array([9.9, 10.4, 60.0])})
    assert experiment.features.reacts(at).tolist() == [True, True, False]
    assert experiment.features.values(at).shape == (3, 4)
    exact = pemviz.build_experiment(replace(load_preset("paper"), plan=False))
    assert exact.features.values(exact.back_end.simulator.initial(count=2)).shape == (2, 3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"position_errors": "yolo"}, "no model of position errors 'yolo'; give one of"),
        ({"position_errors": " "}, "no model of position errors ' '"),
        ({"position_errors": "nowhere.safetensors"}, "nowhere.safetensors: no such file"),
        ({"method": "zero-variance"}, "runs through all states"),
        ({"method": "mixture", "reference": True}, "reference = true"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(changes, words):
    with pytest.raises(InputError, match=words) as caught:
        pemviz.build_experiment(replace(small("monte-carlo"), **changes))
    assert "\n" not in str(caught.value)


def test_a_run_goes_on_with_the_same_position_errors_alone(tmp_path):
    from pemviz.runs.reading import run_differs  # noqa: PLC0415

    config = small("monte-carlo", rollouts=2, final_rollouts=2)
    result = pemviz.run_experiment(config)
    assert run_differs(result, config=config, position_digest=SHIPPED.digest) is None
    difference = run_differs(result, config=config, position_digest="0" * 64)
    assert difference is not None
    assert "other position errors of the name 'pointpillars'" in difference
    with pytest.raises(
        ConfigError,
        match="takes none, only the braking scenario and logical scenarios on vec",
    ):
        pemviz.build_experiment(config, simulator=MissCounter(states=7))


def test_runs_without_errors_know_of_none():
    experiment = pemviz.build_experiment(replace(load_preset("paper"), plan=False))
    assert experiment.back_end.position_errors is None
    states = experiment.back_end.simulator.initial(count=2)
    assert experiment.features.values(states).shape == (2, 3)


@pytest.mark.parametrize("tracker", ["none", "2/3"])
def test_without_a_tracker_the_gap_to_a_missed_car_is_not_measured(tracker, monkeypatch):
    evaluated = []
    monkeypatch.setattr(
        type(SHIPPED),
        "range_error",
        lambda self, salient, noise: evaluated.append(len(noise)) or np.full(len(noise), 0.5),
    )
    simulator = VectorizedSimulator(replace(PAPER, tracker=tracker), SHIPPED)
    draws, states = drawn(40, seed=7), simulator.initial(count=40)
    detected, noise = draws["detected"][:, 0], draws["noise"][:, 0]
    simulator.perceived(states, detected, noise)
    assert evaluated == [detected.sum() if tracker == "none" else 40]
