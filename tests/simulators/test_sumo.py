"""SUMO's steps against the other back ends' and a car-following model's own equation."""

from dataclasses import replace

import numpy as np
import pytest

from pemviz.config import EncounterConfig, ExperimentConfig, ScenarioConfig, StartChoice
from pemviz.config.settings import SumoConfig
from pemviz.config.toml_files import config_table
from pemviz.errors import ConfigError, RunError
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.encounters.vectorized import VectorizedEncounters
from pemviz.simulators.sumo import engine
from pemviz.simulators.sumo.engine import ROADS, Group, Roads
from pemviz.simulators.sumo.scenarios import SumoBraking, SumoEncounters

TOLERANCE = 1e-9
COUNT = ROADS + 3
"""More rollouts than SUMO has roads."""


def drawn(simulator, *, count=COUNT, seed=0):
    """Starts ``[count, S]``, half wider than they are, and outcomes ``[count, T-1, K]``."""
    generator = np.random.default_rng(seed)
    start = 1.5 * generator.standard_normal((count, simulator.latents.start))
    shares = generator.random((count, 1, 1))
    size = (count, simulator.states - 1, len(simulator.slots))
    return {"start": start, "detected": generator.random(size) < shares}


def test_braking_differs_by_half_a_step_s_change_of_the_closing_speed() -> None:
    # The ego brakes for what it detects at any gap: so both back ends accelerate alike.
    config = ScenarioConfig(emergency_gap_m=1e6)
    generator = np.random.default_rng(1)
    detected = generator.random((COUNT, 99)) < generator.random((COUNT, 1))
    exact = replay(simulator=VectorizedSimulator(config), detected=detected)
    got = replay(simulator=SumoBraking(config), detected=detected)
    for name in ("ego_speed", "lead_speed"):
        np.testing.assert_allclose(got[name], exact[name], rtol=0, atol=TOLERANCE)
    grown_mps = exact["ego_speed"] - exact["lead_speed"]
    expected_m = exact["gap"] - config.dt_s / 2 * (grown_mps - grown_mps[:, :1])
    np.testing.assert_allclose(got["gap"], expected_m, rtol=0, atol=TOLERANCE)
    assert np.abs(got["gap"] - exact["gap"]).max() > 0.2
    assert exact["ego_speed"].min() == 0.0


def test_a_scripted_lead_car_of_a_logical_scenario_is_the_specification_s() -> None:
    config = EncounterConfig(logical_scenario="braking", neighbour=True)
    sumo, exact = (
        SumoEncounters(config, sumo=SumoConfig(model="krauss")),
        VectorizedEncounters(config),
    )
    given = drawn(sumo)
    given["detected"] &= False  # the ego keeps its speed
    one, other = (replay(simulator=simulator, **given) for simulator in (sumo, exact))
    free = (one["collided"] == 0.0) & (other["collided"] == 0.0)
    lost_m = config.dt_s / 2 * (other["speed_lead"][:, :1] - other["speed_lead"])
    for name, expected in (
        ("ego_x", other["ego_x"]),
        ("speed_lead", other["speed_lead"]),
        ("gap_lead", other["gap_lead"] - lost_m),
        ("gap_neighbour", other["gap_neighbour"]),
    ):
        np.testing.assert_allclose(one[name][free], expected[free], rtol=0, atol=TOLERANCE)
    assert lost_m[free].max() > 0.4
    assert one["collided"][:, -1].sum() > 10


def test_idm_is_its_equation() -> None:
    """Treiber et al. 2000 with SUMO's parameters: 2.6 and 4.5 m/s^2, 1 s, 2.5 m, exponent 4."""
    sumo = SumoEncounters(EncounterConfig(logical_scenario="cut-out"))
    rollouts = replay(simulator=sumo, **drawn(sumo))
    followed = (rollouts["aside_lead"] == 0.0)[:, :-1] & (rollouts["collided"] == 0.0)[:, 1:]
    along_mps = rollouts["speed_lead"] * np.cos(rollouts["heading_lead"])
    revealed_mps = rollouts["speed_revealed"]
    speed, wanted = along_mps[:, :-1], along_mps[:, :1]
    closing = speed - revealed_mps[:, :-1]
    gap_m = (rollouts["gap_revealed"] - rollouts["gap_lead"])[:, :-1] - 4.5
    desired_m = 2.5 + np.maximum(0.0, speed + speed * closing / (2.0 * np.sqrt(2.6 * 4.5)))
    expected = 2.6 * (1.0 - (speed / wanted) ** 4 - (desired_m / gap_m) ** 2)
    got = np.diff(along_mps, axis=1) / 0.1
    np.testing.assert_allclose(got[followed], expected[followed], rtol=0, atol=2e-3)
    assert expected[followed].min() < -2.0


@pytest.mark.parametrize("model", ["idm", "krauss", "acc"])
def test_a_rollout_depends_on_nothing_else_in_sumo(model) -> None:
    config = EncounterConfig(logical_scenario="cut-out", states=41)
    sumo = SumoEncounters(config, tracker_text="2/3", sumo=SumoConfig(model=model))
    given = drawn(sumo)
    together = replay(simulator=sumo, **given)
    some = slice(40, 47)
    alone = replay(simulator=sumo, **{name: values[some] for name, values in given.items()})
    for name, values in alone.items():
        np.testing.assert_array_equal(values, together[name][some])
    assert together["speed_lead"][:, -1].std() > 0.1


def test_kept_states_go_on_while_another_simulator_uses_sumo() -> None:
    sumo, braking = (
        SumoEncounters(EncounterConfig(logical_scenario="cut-in")),
        SumoBraking(ScenarioConfig()),
    )
    given = drawn(sumo, count=4)
    at_once = replay(simulator=sumo, **given)
    states, other = sumo.initial(count=4, start=given["start"]), braking.initial(count=2)
    kept = []
    for step in range(30):
        kept.append(states)
        states = sumo.step(states, given["detected"][:, step])
        other = braking.step(other, np.zeros(2, dtype=np.bool_))
    again = sumo.step(kept[12], given["detected"][:, 12])
    for name, values in at_once.items():
        np.testing.assert_array_equal(states.signals[name], values[:, 30])
        np.testing.assert_array_equal(again.signals[name], values[:, 13])


def test_a_car_that_wants_no_speed_stands() -> None:
    chosen = (StartChoice("revealed_speed", "0"),)
    sumo = SumoEncounters(EncounterConfig(logical_scenario="cut-out", states=31), chosen)
    assert replay(simulator=sumo, **drawn(sumo, count=3))["speed_revealed"].max() == 0.0


def test_what_sumo_cannot_is_told_in_one_line(monkeypatch) -> None:
    with pytest.raises(ConfigError, match=r"^dt_s = 0\.0125: must be whole milliseconds"):
        SumoBraking(ScenarioConfig(dt_s=0.0125)).roads  # noqa: B018
    far = np.array([[0.0], [9001.0]])
    group = Group(far, np.ones_like(far, dtype=np.int64), far, far, far)
    with pytest.raises(RunError, match=r"^SUMO: a car is more than 9000 m"):
        Roads(0.1, ("ego", "idm"), (4.5, 4.5)).step(group)
    with pytest.raises(RunError, match=r"^SUMO: .*'nobody'"):
        Roads(0.1, ("nobody",), (4.5,)).step(Group(*(one[:1] for one in (far, far, far, far, far))))
    with pytest.raises(ConfigError, match="sumo: must be left out without simulator sumo"):
        ExperimentConfig(sumo=SumoConfig(model="acc")).validate()
    monkeypatch.setattr(engine, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs libsumo; install it with pip install 'pemviz\["):
        build_experiment(ExperimentConfig(simulator="sumo"))


def test_files_name_the_model_where_there_is_one() -> None:
    config = ExperimentConfig(
        simulator="sumo", encounter=EncounterConfig(logical_scenario="cut-in")
    )
    assert config_table(config)["sumo"] == {"model": "idm"}
    for other in (replace(config, simulator="vectorized"), ExperimentConfig(simulator="sumo")):
        assert "sumo" not in config_table(other)
