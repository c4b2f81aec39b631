import math

import pytest

from benchmarks import plain_rollouts
from benchmarks.encounters import scenario_figures
from benchmarks.simulators import simulator_figures
from pemviz.config import ScenarioConfig


def test_rates_and_ratios_belong_together() -> None:
    # One repeat leaves nothing to take medians over: the ratios are the rates'.
    figures = simulator_figures(
        ScenarioConfig(states=5), vectorized_rollouts=10, highway_rollouts=2, repeats=1
    )
    batch, vectorized, highway, bare, gain, cost = (figure.value for figure in figures)
    assert [figure.unit for figure in figures] == ["ms", *["rollouts/s"] * 3, "", ""]
    assert min(batch, vectorized, highway, bare) > 0
    assert math.isclose(10 / vectorized, batch / 1e3)
    assert math.isclose(gain, vectorized / highway)
    assert math.isclose(cost, bare / highway)


@pytest.mark.parametrize("installed", [True, False])
def test_plain_rollouts_say_which_loop_there_is(installed, monkeypatch) -> None:
    if installed:
        pytest.importorskip("numba")
    else:
        monkeypatch.setattr(plain_rollouts, "compiled_loops", lambda: None)
    figures = plain_rollouts.plain_rollout_figures(rollouts=20, repeats=1)
    assert min(figure.value for figure in figures) > 0
    if not installed:
        assert [figure.name for figure in figures if "numba, pemviz[fast]" in figure.name]
        return
    by_numpy, by_loop, gain = (figure.value for figure in figures)
    assert math.isclose(gain, by_loop / by_numpy)


def test_logical_scenarios_have_rates_and_a_ratio_each() -> None:
    fast, fast_steps, slow, _, sumo, sumo_steps, gain = scenario_figures(
        vectorized_rollouts=10,
        highway_rollouts=2,
        sumo_rollouts=3,
        repeats=1,
        states=5,
        logical_scenarios=("cut-in",),
    )
    assert [fast.name, sumo.name] == ["cut-in, vectorized", "cut-in, sumo"]
    assert min(fast.value, slow.value, sumo.value) > 0
    assert math.isclose(gain.value, fast.value / slow.value)
    for rollouts, steps in ((fast, fast_steps), (sumo, sumo_steps)):
        assert math.isclose(steps.value, 4 * rollouts.value)
