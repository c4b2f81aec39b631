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
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.emergency_braking import brakes
from pemviz.simulators.braking.scenario import CAR_WIDTH_M, EGO_LENGTH_M, scenario_tracker

ENVIRONMENT_ID = "pemviz-braking-v0"

SDL_DRIVER_VARIABLE = "SDL_VIDEODRIVER"

FRAME_WIDTH_PX = 640
FRAME_HEIGHT_PX = 160
EGO_RGB, LEAD_RGB = rgb(EGO), rgb(LEAD)


class BrakingState(NamedTuple):
    """All that the future of a rollout depends on, besides perception's outcomes.

    Attributes:
        step: Index of the state in its rollout.
        gap_m: Windscreen camera to the rear of the lead car [m].
        ego_speed_mps: Ego's speed [m/s].
        lead_speed_mps: Lead car's speed [m/s].
        speed_error_integral_m: What the ego's speed controller remembers [m].
    """

    step: int
    gap_m: float
    ego_speed_mps: float
    lead_speed_mps: float
    speed_error_integral_m: float


class ScenarioCar(Vehicle):
    """A car on a straight road that stands rather than reverses and ignores contact."""

    # highway-env would override accelerations beyond these speeds.
    MAX_SPEED = math.inf
    MIN_SPEED = -math.inf
    WIDTH = CAR_WIDTH_M

    def __init__(self, road: Road, *, length_m: float, color: tuple[int, int, int]) -> None:
        self.LENGTH = length_m
        super().__init__(road, position=[0.0, 0.0])
        self.color = color
        self.collidable = False
        self.check_collisions = False

    def step(self, dt: float) -> None:
        """Advance by ``dt`` [s]: position with the old speed, then speed."""
        super().step(dt)
        self.speed = max(self.speed, 0.0)


class LeadCar(ScenarioCar):
    """Brakes from a given time on until it stands."""

    def __init__(self, road: Road, scenario: ScenarioConfig) -> None:
        super().__init__(road, length_m=scenario.lead_length_m, color=LEAD_RGB)
        self.scenario = scenario
        self.step_index = 0

    def act(self, action: Any = None) -> None:  # noqa: ARG002
        """Choose the acceleration; ``action`` is highway-env's and not used."""
        scenario = self.scenario
        braking = self.step_index * scenario.dt_s >= scenario.lead_brake_time_s
        acceleration_mps2 = -scenario.lead_deceleration_mps2 if braking else 0.0
        self.action = {"steering": 0.0, "acceleration": acceleration_mps2}

    def step(self, dt: float) -> None:
        """Advance by ``dt`` [s]."""
        super().step(dt)
        self.step_index += 1


class EgoCar(ScenarioCar):
    """Holds its speed by a PI controller, and brakes hard for a close lead car that it detects."""

    def __init__(self, road: Road, scenario: ScenarioConfig, lead: LeadCar) -> None:
        super().__init__(road, length_m=EGO_LENGTH_M, color=EGO_RGB)
        self.scenario = scenario
        self.lead = lead
        self.lead_present = False
        self.told_gap_m = math.inf
        self.speed_error_integral_m = 0.0
        self.centre_to_camera_m = self.LENGTH / 2 - CAMERA_TO_BUMPER_M
        self.centre_to_zero_gap_m = self.centre_to_camera_m + lead.LENGTH / 2

    @property
    def gap_m(self) -> float:
        """Windscreen camera to the rear of the lead car [m]; negative beyond contact."""
        zero_gap_x_m = self.position[0] + self.centre_to_zero_gap_m
        return float(self.lead.position[0] - zero_gap_x_m)

    @property
    def emergency(self) -> bool:
        """Whether the ego is told of a close lead car."""
        return brakes(self.lead_present, self.told_gap_m, self.scenario)

    def act(self, action: Any = None) -> None:  # noqa: ARG002
        """Choose the acceleration; ``action`` is highway-env's and not used."""
        if self.emergency:
            acceleration_mps2 = -self.scenario.emergency_deceleration_mps2
        else:
            acceleration_mps2 = self._cruise_acceleration()
        self.action = {"steering": 0.0, "acceleration": acceleration_mps2}

    def _cruise_acceleration(self) -> float:
        """The speed controller's output [m/s^2]; its integral grows."""
        scenario = self.scenario
        error_mps = scenario.initial_speed_mps - self.speed
        self.speed_error_integral_m += error_mps * scenario.dt_s
        wanted_mps2 = (
            scenario.speed_gain_per_s * error_mps
            + scenario.speed_integral_gain_per_s2 * self.speed_error_integral_m
        )
        limited_mps2 = max(wanted_mps2, -scenario.maximum_deceleration_mps2)
        return min(limited_mps2, scenario.maximum_acceleration_mps2)


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
        state = self.env.state
        return np.array([state.gap_m, state.ego_speed_mps, state.lead_speed_mps])


class PerceptionOutcome(ActionType):
    """0: the lead car is missed; 1: it is detected."""

    env: "BrakingEnv"

    def space(self) -> spaces.Discrete:
        """Missed or detected."""
        return spaces.Discrete(2)

    def act(self, action: Any) -> None:
        """Nothing: the environment tells the ego as it moves on."""


class BrakingEnv(AbstractEnv):
    """The scenario of ``pemviz.simulators.braking``, stepped with perception's outcomes.

    Observations are :class:`GapObservation`, actions :class:`PerceptionOutcome`. The reward is
    always 0: specifications judge whole rollouts. Contact ends nothing; an episode is
    truncated at its last state.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  declared so by gymnasium
    viewer: EnvViewer | None

    def __init__(
        self, scenario: ScenarioConfig | None = None, render_mode: str | None = None
    ) -> None:
        """Make the environment, in its initial state.

        Args:
            scenario: Parameters; the defaults are the paper's.
            render_mode: ``rgb_array`` to render frames ``[160, 640, 3]`` without a display.
        """
        self.scenario = ScenarioConfig() if scenario is None else scenario
        self.tracker = scenario_tracker(self.scenario)
        super().__init__(config=_view(self.scenario), render_mode=render_mode)

    def update_metadata(self, video_real_time_ratio: float = 1) -> None:
        """Set the frame rate at which a film runs in real time."""
        # The library writes into the dict that all environments of a class share.
        frames_per_s = video_real_time_ratio / self.scenario.dt_s
        self.metadata = {**self.metadata, "render_fps": frames_per_s}

    def define_spaces(self) -> None:
        """Set our own observation and action types."""
        self.observation_type = GapObservation(self)
        self.action_type = PerceptionOutcome(self)
        self.observation_space = self.observation_type.space()
        self.action_space = self.action_type.space()

    @property
    def state(self) -> BrakingState:
        """The current state, from which :meth:`load` can restart."""
        return BrakingState(
            step=self.lead.step_index,
            gap_m=self.ego.gap_m,
            ego_speed_mps=self.ego.speed,
            lead_speed_mps=self.lead.speed,
            speed_error_integral_m=self.ego.speed_error_integral_m,
        )

    def load(self, state: BrakingState) -> None:
        """Put the scene into ``state``; its tracks stay."""
        ego, lead = self.ego, self.lead
        # With the zero of the gap at x = 0 the gap is read back to the last digit.
        ego.position[0] = -ego.centre_to_zero_gap_m
        lead.position[0] = state.gap_m
        ego.speed = state.ego_speed_mps
        lead.speed = state.lead_speed_mps
        ego.speed_error_integral_m = state.speed_error_integral_m
        lead.step_index = self.steps = state.step

    def advance(self, *, detected: bool) -> None:
        """Move one time step on, without the costs of observing, on the true gap."""
        present, gap_m = detected, self.ego.gap_m
        if self.tracker is not None:
            self.tracks = self.tracker.update(
                self.tracks, np.array([detected]), np.array([self.ego.gap_m])
            )
            present, gap_m = bool(self.tracks.confirmed[0]), float(self.tracks.position_m[0, 0])
        self.move(present=present, gap_m=gap_m)

    def move(self, *, present: bool, gap_m: float) -> None:
        """Move one time step on, with the ego told of a lead car there."""
        self.ego.lead_present, self.ego.told_gap_m = present, gap_m
        self.road.act()
        self.road.step(self.scenario.dt_s)
        self.steps += 1

    def render(self) -> Any:
        """A frame, uint8 ``[160, 640, 3]``; ``None`` if no render mode was chosen."""
        if self.viewer is None and self.render_mode is not None:
            with no_display():
                self.viewer = EnvViewer(self)
            self.viewer.enabled = True  # with the dummy driver it leaves frames black
        return super().render()

    def _reset(self) -> None:
        if self.tracker is not None:
            self.tracks = self.tracker.start(1)
        self.road = straight_road(self.scenario)
        self.lead = LeadCar(self.road, self.scenario)
        self.ego = EgoCar(self.road, self.scenario, self.lead)
        self.road.vehicles.extend((self.ego, self.lead))
        self.controlled_vehicles = [self.ego]
        self.load(
            BrakingState(
                step=0,
                gap_m=self.scenario.initial_gap_m,
                ego_speed_mps=self.scenario.initial_speed_mps,
                lead_speed_mps=self.scenario.initial_speed_mps,
                speed_error_integral_m=0.0,
            )
        )

    def _simulate(self, action: Any = None) -> None:
        self.advance(detected=bool(action))

    def _reward(self, action: Any) -> float:  # noqa: ARG002
        return 0.0

    def _is_terminated(self) -> bool:
        return False

    def _is_truncated(self) -> bool:
        return self.steps >= self.scenario.states - 1

    def _info(self, obs: Any, action: Any = None) -> dict[str, Any]:  # noqa: ARG002
        return {"speed_error_integral_m": self.ego.speed_error_integral_m}


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


def _view(scenario: ScenarioConfig) -> dict[str, Any]:
    """Show gaps up to the declared bound; the ego stays near the left edge."""
    ego_share = 0.1
    span_m = scenario.gap_bound_m + scenario.lead_length_m + EGO_LENGTH_M
    scale_px_per_m = FRAME_WIDTH_PX * (1 - ego_share) / span_m
    return {
        "screen_width": FRAME_WIDTH_PX,
        "screen_height": FRAME_HEIGHT_PX,
        "centering_position": [ego_share, 0.5],
        "offscreen_rendering": True,
        "scaling": float(np.clip(scale_px_per_m, 2.0, 20.0)),
        "simulation_frequency": 1 / scenario.dt_s,
        "policy_frequency": 1 / scenario.dt_s,
    }


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
