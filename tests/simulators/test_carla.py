"""The braking scenario on CARLA: what needs no server, with the real client where it takes part.

PEMVIZ_CARLA=HOST:PORT names a server for the tests that need one.
"""

import json
import math
import os
import socket
import subprocess
import sys

import numpy as np
import pytest

from pemviz.cli.main import main
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.settings import read_address
from pemviz.config.toml_files import config_text
from pemviz.errors import ConfigError, RunError
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.carla import server
from pemviz.simulators.carla.braking import CarlaBraking, CarPlace, Pedals, gap_m, pedals, place_of
from pemviz.simulators.episodic import SideBySide

CONFIG = ScenarioConfig()


@pytest.fixture(scope="module")
def carla():
    return pytest.importorskip("carla", reason="CARLA's client is not installed")


@pytest.fixture
def closed_port():
    """A port of this machine on which nothing listens."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


@pytest.mark.parametrize("text", ["", "2000", ":2000", "host:", "host:x", "a b:1", "h:²"])
def test_an_address_is_host_and_port(text) -> None:
    with pytest.raises(ConfigError, match=r"must be HOST:PORT, such as 127\.0\.0\.1:2000$"):
        read_address(text)


def test_addresses_are_read_and_kept_in_a_configuration() -> None:
    assert read_address("sim.example:2000") == ("sim.example", 2000)
    assert read_address("::1:65535") == ("::1", 65535)
    with pytest.raises(ConfigError, match="port must be from 1 to 65535"):
        read_address("host:65536")
    assert "carla" not in config_text(ExperimentConfig())
    asked = ExperimentConfig(simulator="carla", carla="host:2000")
    asked.validate()
    assert 'carla = "host:2000"' in config_text(asked)
    with pytest.raises(ConfigError, match="must be left out without simulator carla"):
        ExperimentConfig(carla="host:2000").validate()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--carla", "nowhere"], "must be HOST:PORT"),
        (["--method", "monte-carlo"], "nothing to connect to (Connection refused); is the server"),
    ],
)
def test_no_server_is_one_line_and_exit_code_2(
    carla, closed_port, tmp_path, capsys, options, words
) -> None:
    given = [] if "--carla" in options else ["--carla", f"127.0.0.1:{closed_port}"]
    asked = ["record", "--simulator", "carla", *given, *options, "--out", str(tmp_path / "runs")]
    assert main(asked) == 2
    told = capsys.readouterr().err.strip()
    assert words in told
    assert "\n" not in told
    assert not (tmp_path / "runs").exists()


def test_something_else_that_listens_is_told_from_a_server(carla) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        words = r"something listens, but not as a CARLA server \(time-out of 300ms"
        with pytest.raises(ConfigError, match=words):
            server.connected("127.0.0.1", port, connect_s=0.3)


def test_a_server_of_another_version_or_of_somebody_else_is_refused(carla) -> None:
    mine = carla.Client("127.0.0.1", 1).get_client_version()
    server.check_version("x", client=mine, server=f"{mine}-12-gabcdef")
    with pytest.raises(ConfigError, match=rf"x: the server is CARLA 0\.9\.15, the client {mine}"):
        server.check_version("x", client=mine, server="0.9.15")
    server.check_free("x", carla.WorldSettings())
    with pytest.raises(ConfigError, match="driven by another client already"):
        server.check_free("x", carla.WorldSettings(synchronous_mode=True))


def test_a_lost_server_is_one_line(carla, closed_port) -> None:
    client = carla.Client("127.0.0.1", closed_port)
    client.set_timeout(0.2)
    with (
        pytest.raises(RunError, match=r"^here: the server is lost, or refuses: time-out of 200ms"),
        server.answering("here"),
    ):
        client.get_world()


def test_settings_are_synchronous_and_substeps_fill_a_tick(carla) -> None:
    for dt_s, substeps in ((0.05, 5), (0.01, 1), (0.025, 3), (0.001, 1)):
        settings = server.synchronous(carla.WorldSettings(), dt_s)
        assert settings.synchronous_mode
        assert settings.no_rendering_mode
        assert settings.fixed_delta_seconds == pytest.approx(dt_s)
        assert settings.max_substeps == substeps
        assert settings.max_substep_delta_time * substeps == pytest.approx(dt_s)


@pytest.mark.parametrize(("yaw", "along", "centre"), [(0, (1, 0), 10.3), (90, (0, 1), 20.3),
                                                      (180, (1, 0), 9.7)])  # fmt: skip
def test_places_are_those_of_the_boxes_along_the_road(carla, yaw, along, centre) -> None:
    place = place_of(
        carla.Transform(carla.Location(10.0, 20.0, 0.1), carla.Rotation(yaw=yaw)),
        carla.Vector3D(3.0, 5.0, 0.0),
        carla.BoundingBox(carla.Location(0.3, 0.0, 0.7), carla.Vector3D(2.5, 1.0, 0.7)),
        along=carla.Vector3D(*map(float, along), 0.0),
    )
    assert place.rear_m == pytest.approx(centre - 2.5, abs=1e-5)
    assert place.front_m == pytest.approx(centre + 2.5, abs=1e-5)
    assert place.speed_mps == pytest.approx(3.0 if along == (1, 0) else 5.0)


def test_bumpers_touch_at_a_gap_of_two_metres() -> None:
    assert gap_m(CarPlace(0.0, 5.0, 1.0), CarPlace(5.0, 10.0, 1.0)) == 2.0


@pytest.mark.parametrize(
    ("mps2", "asked"),
    [(0.0, Pedals(0, 0)), (0.5, Pedals(0.5, 0)), (7.0, Pedals(1, 0)), (-2.0, Pedals(0, 0.25)),
     (-8.0, Pedals(0, 1)), (-9.0, Pedals(0, 1))],
)  # fmt: skip
def test_accelerations_are_shares_of_the_limits(mps2, asked) -> None:
    assert pedals(mps2, CONFIG) == asked


def test_an_ego_that_may_not_accelerate_rolls() -> None:
    assert pedals(1.0, ScenarioConfig(maximum_acceleration_mps2=0.0)) == Pedals(0, 0)


def test_carlas_own_reader_finds_the_road_straight_and_long_enough(carla) -> None:
    length_m = server.road_length_m(CONFIG, lead_in_s=1.0)
    road = carla.Map("pemviz", server.road_text(length_m))
    for s_m in (0.5, 30.0, length_m - 1.0):
        place = road.get_waypoint_xodr(server.ROAD_ID, server.LANE_ID, s_m)
        assert place.transform.location.x == pytest.approx(s_m, abs=1e-3)
        assert abs(place.transform.location.y) == pytest.approx(1.75, abs=1e-3)
        assert math.cos(math.radians(place.transform.rotation.yaw)) == pytest.approx(1.0)
        assert place.lane_width == pytest.approx(3.5)
        assert place.lane_type == carla.LaneType.Driving
    assert length_m > 30.0 + 15.0 + 70 / 3.6 * 6.0


class ByPedals:
    """Two cars that do exactly what pedals ask, by explicit Euler steps: what no server does."""

    def __init__(self, config, *, fails_at=math.inf):
        self.config, self.fails_at, self.closed = config, fails_at, 0

    def begin(self):
        self.steps, speed = 0, self.config.initial_speed_mps
        self.ego = CarPlace(-5.0, 0.0, speed)
        rear = self.config.initial_gap_m - 2.0
        self.lead = CarPlace(rear, rear + 5.0, speed)
        return self.ego, self.lead

    def step(self, pressed, lead_mps):
        self.steps += 1
        if self.steps >= self.fails_at:
            raise RunError("the server is lost")
        config, ego, lead = self.config, self.ego, self.lead
        mps2 = (
            pressed.throttle * config.maximum_acceleration_mps2
            - pressed.brake * config.emergency_deceleration_mps2
        )
        changed = max(ego.speed_mps + mps2 * config.dt_s, 0.0)
        self.ego = self._driven(ego, changed)
        self.lead = self._driven(lead, lead_mps)
        return self.ego, self.lead

    def _driven(self, car, speed_mps):
        way = car.speed_mps * self.config.dt_s
        return CarPlace(car.rear_m + way, car.front_m + way, speed_mps)

    def close(self):
        self.closed += 1


@pytest.mark.parametrize("tracker", ["none", "2/3,coast=0.1,filter=kalman"])
def test_cars_that_obey_follow_the_vectorized_back_end(tracker) -> None:
    config = ScenarioConfig(tracker=tracker)
    detected = np.random.default_rng(7).random((99, 1)) < 0.4
    exact = VectorizedSimulator(config)
    states, episode = exact.initial(count=1), CarlaBraking(config, ByPedals(config))
    told, ended = episode.reset(), False
    for outcome in detected:
        for name, values in states.signals.items():
            assert told[name] == pytest.approx(values[0], abs=1e-9)
        assert ended == (states.signals["gap"][0] <= 2.0)
        states = exact.step(states, outcome)
        told, ended = episode.step(bool(outcome[0]))
    again = episode.reset()
    assert again == {"gap": 15.0, "ego_speed": 70 / 3.6, "lead_speed": 70 / 3.6}


def test_a_rollout_ends_at_contact_and_stands_side_by_side() -> None:
    made = SideBySide(make=lambda: CarlaBraking(CONFIG, ByPedals(CONFIG)))
    states = made.initial(count=1)
    gaps = [states.signals["gap"][0]]
    for _ in range(CONFIG.states - 1):
        states = made.step(states, np.array([False]))
        gaps.append(states.signals["gap"][0])
    touching = int(np.argmax(np.array(gaps) <= 2.0))
    assert 0 < touching < 99
    assert len(set(gaps[touching:])) == 1


def test_what_fails_in_a_step_leaves_nothing_behind() -> None:
    cars = ByPedals(CONFIG, fails_at=3)
    episode = CarlaBraking(CONFIG, cars)
    episode.reset()
    episode.step(True)
    episode.step(True)
    with pytest.raises(RunError, match="the server is lost"):
        episode.step(True)
    assert cars.closed == 1


def test_all_that_can_be_undone_is_undone() -> None:
    done = []

    def refused():
        raise RuntimeError("time-out")

    server.undo_all([refused, lambda: done.append("settings")])
    assert done == ["settings"]


def test_the_client_is_not_imported_unless_asked_for() -> None:
    code = "import sys, pemviz.runs.back_ends, pemviz.simulators.carla.server, pemviz.cli.record; "
    code += "sys.exit('carla' in sys.modules or 'carla.libcarla' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_a_short_run_on_a_server(carla, tmp_path, capsys) -> None:
    address = os.environ.get("PEMVIZ_CARLA")
    if address is None:
        pytest.skip("PEMVIZ_CARLA = HOST:PORT names no CARLA server")
    asked = ["record", "--simulator", "carla", "--carla", address, "--method", "naive", "--json"]
    few = ["--final-rollouts", "4", "--no-recording", "--out", str(tmp_path)]
    assert main([*asked, *few]) in (0, 4)
    result = json.loads(capsys.readouterr().out)
    assert result["status"] == "done"
    client = carla.Client(*read_address(address))
    world = client.get_world()
    assert not world.get_settings().synchronous_mode
    assert not list(world.get_actors().filter("vehicle.*"))
