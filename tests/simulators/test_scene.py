"""What a scenario tells of its cars: kept to before a run, found behind wrappers."""

from dataclasses import replace

import numpy as np
import pytest

import pemviz
from pemviz.simulators.check import check_simulator
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.simulators.latents import WrappedSimulator, within
from pemviz.simulators.scene import DrawsTracks
from pemviz.simulators.slots import UnrolledSimulator
from tests.lattice_walk import ToySimulator
from tests.scene_toys import CutIn


def scene_with(**changes):
    return lambda simulator, signals: replace(CutIn.scene(simulator, signals), **changes)


def tracks_with(**changes):
    return lambda simulator, states: replace(CutIn.scene_tracks(simulator, states), **changes)


def raising(simulator, signals):
    raise KeyError("x of\nthe lead")


LOW = (-5.0, -5.0)
RAMP = pemviz.Ramp(x_m=(0.0, 9.0), right_m=(-4.0, -4.0), left_m=(0.0, -1.0))
EGO, LEAD, CUTTER = CutIn.scene_cars
WRONG = {
    "scene_cars must be a tuple": {"scene_cars": ()},
    r"is named ' '": {"scene_cars": (replace(EGO, name=" "), LEAD)},
    "name of its own": {"scene_cars": (EGO, LEAD, replace(LEAD, slot="cutter"))},
    "must be above 0 and finite": {"scene_cars": (EGO, replace(LEAD, width_m=0.0))},
    r"slot 'bus': must be one of lead, cutter": {"scene_cars": (EGO, replace(LEAD, slot="bus"))},
    "road is a tuple": {"road": (0.0, 3.5)},
    "lane_edges_m = .* ascending": {"road": pemviz.Road(lane_edges_m=(3.5, 0.0))},
    "ramps = .* must be a tuple of pemviz.Ramp": {"road": pemviz.Road((0.0, 3.5), ramps=[RAMP])},
    "a ramp .* x_m ascending": {"road": pemviz.Road((0.0, 3.5), (replace(RAMP, x_m=(9.0, 0.0)),))},
    "ascending and left_m above": {"road": pemviz.Road((0.0, 3.5), (replace(RAMP, left_m=LOW),))},
    "a ramp .* 2 places": {"road": pemviz.Road((0.0, 3.5), (replace(RAMP, right_m=(-4.0,)),))},
    r"scene: y_m is float64 of shape \(4,\)": {"scene": scene_with(y_m=np.zeros(4))},
    "scene: x_m must be finite": {"scene": lambda s, signals: replace(
        CutIn.scene(s, signals),
        x_m=np.full((*signals["ego_x"].shape, 3), np.nan))},
    "scene gives a dict": {"scene": lambda s, signals: {}},
    "scene raises KeyError: 'x of": {"scene": raising},
    "scene_tracks: confirmed is float64": {"scene_tracks": tracks_with(confirmed=np.zeros((4, 2)))},
    "x_sd_m of a track must be finite and at least 0": {"scene_tracks": lambda s, states: replace(
        CutIn.scene_tracks(s, states),
        x_sd_m=np.full((*states.shape, 2), -1.0))},
}  # fmt: skip


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_scene_is_told_in_one_line(words):
    bent = type("Bent", (CutIn,), WRONG[words])()
    with pytest.raises(pemviz.ConfigError, match=words) as told:
        check_simulator(bent)
    assert "\n" not in str(told.value)
    assert str(told.value).startswith("simulator 'toy-cut-in': ")


def test_a_scene_that_keeps_to_the_contract_passes_and_is_found_behind_wrappers():
    scenario = CutIn()
    check_simulator(scenario)
    wrapped = WrappedSimulator(UnrolledSimulator(scenario))
    assert drawn_scene(wrapped) is scenario
    assert within(wrapped, DrawsTracks) is scenario
    assert drawn_scene(ToySimulator()) is None
    assert within(UnrolledSimulator(ToySimulator()), DrawsTracks) is None
