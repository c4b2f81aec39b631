"""The braking scenario as a highway-env environment; imports highway-env.

Importing this module registers the environment with gymnasium, so either of these makes one::

    import pemviz.simulators.braking.highway_env_scenario
    gymnasium.make("pemviz-braking-v0", render_mode="rgb_array")

    gymnasium.make("pemviz.simulators.braking.highway_env_scenario:pemviz-braking-v0")

It is imported only where it is needed, since highway-env brings pygame and pandas along.
"""

import math
import os
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.graphics import EnvViewer
from highway_env.envs.common.observation import ObservationType
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

from pemviz.arrays import FloatArray
from pemviz.colors import EGO, LEAD, rgb
from pemviz.config import EncounterConfig, ScenarioConfig
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.scenario import CAR_WIDTH_M, EGO_LENGTH_M, brakes, scenario_tracker

ENVIRONMENT_ID = "pemviz-braking-v0"
SDL_DRIVER_VARIABLE = "SDL_VIDEODRIVER"
FRAME_WIDTH_PX, FRAME_HEIGHT_PX = 640, 160
EGO_SHARE = 0.1
"""Of a frame's width, at which the ego stays."""
EGO_RGB, LEAD_RGB = rgb(EGO), rgb(LEAD)


class BrakingState(NamedTuple):
    """All that the future of a rollout depends on, besides perception's outcomes."""

    step: int
    gap_m: float
    ego_speed_mps: float
    lead_speed_mps: float
    speed_error_integral_m: float


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


class GapObservation(ObservationType):
    """Gap [m], ego speed and lead speed [m/s], as float64 ``[3]``."""

    env: "BrakingEnv"

    def space(self) -> spaces.Box:
        """What the scenario can reach: the bounds hold for every sequence of outcomes."""
        scenario = self.env.scenario
        duration_s = scenario.states * scenario.dt_s
        lead_mps = scenario.initial_speed_mps
        ego_mps = lead_mps + scenario.maximum_acceleration_mps2 * duration_s
        return spaces.Box(
            low=np.array([scenario.initial_gap_m - ego_mps * duration_s, 0.0, 0.0]),
            high=np.array([scenario.initial_gap_m + lead_mps * duration_s, ego_mps, lead_mps]),
            dtype=np.float64,
        )

    def observe(self) -> FloatArray:
        """The current state's signals ``[3]``."""
        return np.array(self.env.state[1:4])


class PerceptionOutcome(ActionType):
    """0: the lead car is missed; 1: it is detected."""

    env: "BrakingEnv"

    def space(self) -> spaces.Discrete:
        """Missed or detected."""
        return spaces.Discrete(2)

    def act(self, action: Any) -> None:
        """Nothing: the environment tells the ego as it moves on."""


class BrakingEnv(ScriptedEnv):
    """The scenario of ``pemviz.simulators.braking``, stepped with perception's outcomes.

    Observations are :class:`GapObservation`, actions :class:`PerceptionOutcome`.
    """

    def __init__(
        self, scenario: ScenarioConfig | None = None, render_mode: str | None = None
    ) -> None:
        """Make the environment, in its initial state.

        Args:
            scenario: Parameters; the defaults are the paper's.
            render_mode: ``rgb_array`` to render frames ``[160, 640, 3]`` without a display.
        """
        self.scenario = scenario = ScenarioConfig() if scenario is None else scenario
        self.tracker = scenario_tracker(scenario)
        self.centre_to_zero_gap_m = (
            EGO_LENGTH_M / 2 - CAMERA_TO_BUMPER_M + scenario.lead_length_m / 2
        )
        shown_m = scenario.gap_bound_m + scenario.lead_length_m + EGO_LENGTH_M
        super().__init__(scenario, shown_m=shown_m, render_mode=render_mode)

    def define_spaces(self) -> None:
        """Set our own observation and action types."""
        self.set_spaces(GapObservation(self), PerceptionOutcome(self))

    @property
    def gap_m(self) -> float:
        """Windscreen camera to the rear of the lead car [m]; negative beyond contact."""
        zero_gap_x_m = self.ego.position[0] + self.centre_to_zero_gap_m
        return float(self.lead.position[0] - zero_gap_x_m)

    @property
    def state(self) -> BrakingState:
        """The current state, from which :meth:`load` can restart."""
        speeds_mps = (self.ego.speed, self.lead.speed)
        return BrakingState(self.steps, self.gap_m, *speeds_mps, self.speed_error_integral_m)

    def load(self, state: BrakingState) -> None:
        """Put the scene into ``state``; its tracks stay."""
        # With the zero of the gap at x = 0 the gap is read back to the last digit.
        self.ego.position[0] = -self.centre_to_zero_gap_m
        self.steps, self.lead.position[0], self.ego.speed, self.lead.speed = state[:4]
        self.speed_error_integral_m = state.speed_error_integral_m

    def advance(self, *, detected: bool) -> None:
        """Move one time step on, without the costs of observing, on the true gap."""
        present, gap_m = detected, self.gap_m
        if self.tracker is not None:
            hit = np.array([detected])
            self.tracks = self.tracker.update(self.tracks, hit, np.array([gap_m]))
            present, gap_m = bool(self.tracks.confirmed[0]), float(self.tracks.position_m[0, 0])
        self.move(present=present, gap_m=gap_m)

    def move(self, *, present: bool, gap_m: float) -> None:
        """Move one time step on, with the ego told of a lead car there."""
        scenario = self.scenario
        braking = self.steps * scenario.dt_s >= scenario.lead_brake_time_s
        self.lead.accelerate(-scenario.lead_deceleration_mps2 if braking else 0.0)
        if brakes(present, gap_m, scenario):
            self.ego.accelerate(-scenario.emergency_deceleration_mps2)
        else:
            self.ego.accelerate(self._cruise_acceleration())
        self.road.step(scenario.dt_s)
        self.steps += 1

    def _cruise_acceleration(self) -> float:
        """The speed controller's output [m/s^2]; its integral grows."""
        scenario = self.scenario
        error_mps = scenario.initial_speed_mps - self.ego.speed
        self.speed_error_integral_m += error_mps * scenario.dt_s
        wanted_mps2 = (
            scenario.speed_gain_per_s * error_mps
            + scenario.speed_integral_gain_per_s2 * self.speed_error_integral_m
        )
        limited_mps2 = max(wanted_mps2, -scenario.maximum_deceleration_mps2)
        return min(limited_mps2, scenario.maximum_acceleration_mps2)

    def _reset(self) -> None:
        scenario = self.scenario
        if self.tracker is not None:
            self.tracks = self.tracker.start(1)
        self.road = straight_road(scenario)
        self.ego, self.lead = (
            ScriptedCar(self.road, length_m=length_m, width_m=CAR_WIDTH_M, color=color)
            for length_m, color in ((EGO_LENGTH_M, EGO_RGB), (scenario.lead_length_m, LEAD_RGB))
        )
        self.road.vehicles.extend((self.ego, self.lead))
        self.controlled_vehicles = [self.ego]
        speed_mps = scenario.initial_speed_mps
        self.load(BrakingState(0, scenario.initial_gap_m, speed_mps, speed_mps, 0.0))

    def _simulate(self, action: Any = None) -> None:
        self.advance(detected=bool(action))

    def _info(self, obs: Any, action: Any = None) -> dict[str, Any]:  # noqa: ARG002
        return {"speed_error_integral_m": self.speed_error_integral_m}


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


if ENVIRONMENT_ID not in gymnasium.registry:
    gymnasium.register(id=ENVIRONMENT_ID, entry_point=f"{__name__}:{BrakingEnv.__name__}")
