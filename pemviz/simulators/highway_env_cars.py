"""Cars that highway-env moves and draws; this module imports highway-env, and pygame.

It is imported only where it is needed, since highway-env brings pygame and pandas along.
"""

import math
import os
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.graphics import EnvViewer
from highway_env.envs.common.observation import ObservationType
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

from pemviz.colors import EGO, LEAD, rgb
from pemviz.config import EncounterConfig, ScenarioConfig

SDL_DRIVER_VARIABLE = "SDL_VIDEODRIVER"
FRAME_WIDTH_PX, FRAME_HEIGHT_PX = 640, 160
EGO_SHARE = 0.1
"""Of a frame's width, at which the ego stays."""
EGO_RGB, LEAD_RGB = rgb(EGO), rgb(LEAD)


class ScriptedCar(Vehicle):
    """A car that goes where it heads and stands rather than reverses; contact is not its own."""

    # highway-env would override accelerations beyond these speeds.
    MAX_SPEED = math.inf
    MIN_SPEED = -math.inf

    def __init__(
        self, road: Road, *, length_m: float, width_m: float, color: tuple[int, int, int]
    ) -> None:
        self.LENGTH, self.WIDTH = length_m, width_m
        super().__init__(road, position=[0.0, 0.0])
        self.color = color
        self.collidable = self.check_collisions = False

    def accelerate(self, acceleration_mps2: float) -> None:
        """Keep this acceleration over the next step; the wheel is straight."""
        self.action = {"steering": 0.0, "acceleration": acceleration_mps2}

    def step(self, dt: float) -> None:
        """Advance by ``dt`` [s]: position with the old speed, then speed."""
        super().step(dt)
        self.speed = max(self.speed, 0.0)


class CarsOnRoad:
    """C cars on a road, the ego first; highway-env's y grows to the right."""

    def __init__(
        self, road: Road, *, lengths_m: Sequence[float], width_m: float, dt_s: float
    ) -> None:
        """Put cars of these ``lengths_m`` on an empty road that is stepped by ``dt_s``."""
        self.road, self.dt_s = road, dt_s
        self.cars = [
            ScriptedCar(
                road, length_m=length_m, width_m=width_m, color=LEAD_RGB if car else EGO_RGB
            )
            for car, length_m in enumerate(lengths_m)
        ]
        road.vehicles = list[Vehicle](self.cars)

    def put(self, places: Sequence[Sequence[float]]) -> None:
        """Put all cars into places; see :attr:`pemviz.simulators.scene.SceneStates.of_cars`."""
        for car, (x_m, y_m, heading_rad, speed_mps) in zip(self.cars, places, strict=True):
            car.position = np.array([x_m, -y_m])
            car.heading, car.speed = -heading_rad, speed_mps

    def moved(
        self, places: Sequence[Sequence[float]], does_mps2: Sequence[float]
    ) -> list[tuple[float, float, float]]:
        """Places x and y [m] and speeds [m/s], a step after places with constant accelerations."""
        self.put(places)
        for car, acceleration_mps2 in zip(self.cars, does_mps2, strict=True):
            car.accelerate(acceleration_mps2)
        self.road.step(self.dt_s)
        return [(car.position[0], -car.position[1], car.speed) for car in self.cars]


class ScriptedEnv(AbstractEnv):
    """A scenario stepped with perception's outcomes; a subclass adds ``_reset`` and ``_simulate``.

    The reward is always 0: specifications judge whole rollouts. Contact ends nothing; an episode
    is truncated at its last state.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  declared so by gymnasium
    viewer: EnvViewer | None

    def __init__(
        self, scenario: ScenarioConfig | EncounterConfig, *, shown_m: float, render_mode: str | None
    ) -> None:
        """Make the environment, in its initial state.

        Args:
            scenario: Its parameters.
            shown_m: How much of the road ahead of the ego a frame shows [m].
            render_mode: ``rgb_array`` to render frames ``[160, 640, 3]`` without a display.
        """
        self.dt_s, self.last_step = scenario.dt_s, scenario.states - 1
        view = {
            "screen_width": FRAME_WIDTH_PX,
            "screen_height": FRAME_HEIGHT_PX,
            "centering_position": [EGO_SHARE, 0.5],
            "offscreen_rendering": True,
            "scaling": float(np.clip(FRAME_WIDTH_PX * (1 - EGO_SHARE) / shown_m, 2.0, 20.0)),
            "simulation_frequency": 1 / scenario.dt_s,
            "policy_frequency": 1 / scenario.dt_s,
        }
        super().__init__(config=view, render_mode=render_mode)

    def update_metadata(self, video_real_time_ratio: float = 1) -> None:
        """Set the frame rate at which a film runs in real time."""
        # The library writes into the dict that all environments of a class share.
        self.metadata = {**self.metadata, "render_fps": video_real_time_ratio / self.dt_s}

    def set_spaces(self, observation: ObservationType, action: ActionType) -> None:
        """Set our own observation and action types."""
        self.observation_type, self.action_type = observation, action
        self.observation_space, self.action_space = observation.space(), action.space()

    def render(self) -> Any:
        """A frame, uint8 ``[160, 640, 3]``; ``None`` if no render mode was chosen."""
        if self.viewer is None and self.render_mode is not None:
            with no_display():
                self.viewer = EnvViewer(self)
            self.viewer.enabled = True  # with the dummy driver it leaves frames black
        return super().render()

    def _reward(self, action: Any) -> float:  # noqa: ARG002
        return 0.0

    def _is_terminated(self) -> bool:
        return False

    def _is_truncated(self) -> bool:
        return self.steps >= self.last_step


def straight_road(scenario: ScenarioConfig) -> Road:
    """An empty lane, as long as the scenario can need."""
    duration_s = scenario.states * scenario.dt_s
    speed_mps = scenario.initial_speed_mps + scenario.maximum_acceleration_mps2 * duration_s
    margin_m = 1000.0
    lane = StraightLane(
        [-margin_m, 0.0],
        [scenario.initial_gap_m + speed_mps * duration_s + margin_m, 0.0],
        # A dashed line on one side shows in a film that the cars move.
        line_types=(LineType.STRIPED, LineType.CONTINUOUS_LINE),  # pyright: ignore[reportArgumentType]  its constants are plain integers
    )
    network = RoadNetwork()
    network.add_lane("start", "end", lane)
    return Road(network=network)


def three_lanes(config: EncounterConfig) -> Road:
    """An empty road for encounters, as long as one can need."""
    length_m, network = 20_000.0, RoadNetwork()
    sides = (LineType.STRIPED, LineType.CONTINUOUS_LINE)
    for lane in (-1, 0, 1):
        left, right = sides[lane == -1], sides[lane == 1]
        y_m = lane * config.lane_width_m
        types: Any = (left, right)
        ends = [-length_m, y_m], [length_m, y_m]
        lane_of = StraightLane(*ends, width=config.lane_width_m, line_types=types)
        network.add_lane("start", "end", lane_of)
    return Road(network=network)


@contextmanager
def no_display() -> Generator[None]:
    """Have SDL look for no display: frames need none, and it complains where there is none."""
    chosen = os.environ.get(SDL_DRIVER_VARIABLE)
    os.environ[SDL_DRIVER_VARIABLE] = "dummy"
    try:
        yield
    finally:
        if chosen is None:
            del os.environ[SDL_DRIVER_VARIABLE]
        else:
            os.environ[SDL_DRIVER_VARIABLE] = chosen
