"""What a simulator says of its start values is tried before a run, whatever wraps it."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pemviz
from pemviz.simulators.check import check_simulator
from pemviz.simulators.latents import NamesStarts, within

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "random_start.py"
STANDING_CAR = runpy.run_path(str(EXAMPLE))["StandingCar"]
GAP, SPEED = STANDING_CAR().starts


def car(**members):
    """The example with members replaced; functions get it and the latents."""
    bent = type("Bent", (STANDING_CAR,), {"__annotations__": {}})()
    for name, value in members.items():
        given = (lambda start, value=value: value(bent, start)) if callable(value) else value
        object.__setattr__(bent, name, given)
    return bent


def own_values(bent, start):
    return STANDING_CAR.start_values(bent, start)


WRONG = {
    "starts must be a tuple of one": car(starts=()),
    "starts must be a tuple": car(starts=("gap", "speed")),
    "each once": car(starts=(GAP, replace(SPEED, key="gap_m"))),
    "gap: low must be below high": car(starts=(replace(GAP, low=90.0), SPEED)),
    "start_plane = ('gap', 'lead'): must be two of gap, speed": car(start_plane=("gap", "lead")),
    "must be two of": car(start_plane=("gap", "gap")),
    "start_values gives gap: must give gap, speed": car(
        start_values=lambda bent, start: {"gap": own_values(bent, start)["gap"]}
    ),
    "speed has shape (): must be (5,)": car(
        start_values=lambda bent, start: own_values(bent, start) | {"speed": np.float64(3.0)}
    ),
    "speed must be finite": car(
        start_values=lambda bent, start: own_values(bent, start) | {"speed": np.full(5, np.nan)}
    ),
    "gap must not depend on the other rollouts": car(
        start_values=lambda bent, start: own_values(bent, start) | {"gap": np.cumsum(start[:, 0])}
    ),
    "start_values raises IndexError": car(start_values=lambda bent, start: start[:, 9]),
}


@pytest.mark.parametrize("words", WRONG)
def test_names_and_values_that_do_not_fit_are_refused_in_one_line(words):
    with pytest.raises(pemviz.ConfigError) as caught:
        check_simulator(WRONG[words])
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_they_are_found_inside_of_what_wraps_the_scenario():
    simulator = STANDING_CAR()
    assert isinstance(simulator, pemviz.NamesStarts)
    config = pemviz.ExperimentConfig(memory_s=0.2, spec="always[0,50] (gap >= 0.0)")
    behind = pemviz.tracked(simulator, pemviz.Tracker(hits=2, window=3, dt_s=0.1))
    pem = runpy.run_path(str(EXAMPLE))["Camera"]()
    experiment = pemviz.build_experiment(config, simulator=behind, pem=pem)
    assert within(experiment.problem.simulator, NamesStarts) is simulator
    assert within(object(), NamesStarts) is None
