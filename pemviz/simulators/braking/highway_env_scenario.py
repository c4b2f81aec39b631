"""The braking scenario as a highway-env environment, and films; imports highway-env.

Importing this module registers the environment with gymnasium, so either of these makes one::

    import pemviz.simulators.braking.highway_env_scenario
    gymnasium.make("pemviz-braking-v0", render_mode="rgb_array")

    gymnasium.make("pemviz.simulators.braking.highway_env_scenario:pemviz-braking-v0")
"""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.observation import ObservationType
from numpy.typing import NDArray

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.highway import HighwaySimulator, cars_on_road
from pemviz.simulators.braking.scenario import EGO_LENGTH_M, GAP, SPEED_ERROR_INTEGRAL
from pemviz.simulators.highway_env_cars import ScriptedEnv
from pemviz.types import StateBatch

ENVIRONMENT_ID = "pemviz-braking-v0"


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
        return np.concatenate(list(self.env.states.signals.values()))


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
        self.back_end, self.on_road = HighwaySimulator(scenario), cars_on_road(scenario)
        shown_m = scenario.gap_bound_m + scenario.lead_length_m + EGO_LENGTH_M
        super().__init__(scenario, shown_m=shown_m, render_mode=render_mode)

    def define_spaces(self) -> None:
        """Set our own observation and action types."""
        self.set_spaces(GapObservation(self), PerceptionOutcome(self))

    def show(self, states: StateBatch) -> None:
        """Be in the state of one rollout of the back end, ``[1]``."""
        self.states, self.steps = states, int(states.step)
        self.on_road.put(self.back_end.places(states)[0])

    def advance(self, *, detected: bool) -> None:
        """Move one time step on, without the costs of observing."""
        self.show(self.back_end.step(self.states, np.array([detected])))

    def _reset(self) -> None:
        self.road, self.controlled_vehicles = self.on_road.road, self.on_road.cars[:1]
        self.show(self.back_end.initial(count=1))

    def _simulate(self, action: Any = None) -> None:
        self.advance(detected=bool(action))

    def _info(self, obs: Any, action: Any = None) -> dict[str, Any]:  # noqa: ARG002
        return {SPEED_ERROR_INTEGRAL: float(self.states.memory[SPEED_ERROR_INTEGRAL][0])}


def frames(config: ScenarioConfig, *, detected: BoolArray) -> Iterator[NDArray[np.uint8]]:
    """Film a rollout with outcomes ``[T-1]``; needs no display.

    Returns:
        T frames, one a state, each ``[160, 640, 3]`` RGB: the road from above, the ego blue at
        the left and the lead car orange. From contact on the last frame before it, in grey.

    Raises:
        ValueError: ``detected`` has another shape.
    """
    if detected.shape != (config.states - 1,):
        message = f"detected has shape {detected.shape}, expected ({config.states - 1},)"
        raise ValueError(message)
    return _film(config, detected)


def _film(config: ScenarioConfig, detected: BoolArray) -> Iterator[NDArray[np.uint8]]:
    environment = BrakingEnv(config, render_mode="rgb_array")
    try:
        frame, touching = environment.render(), False
        yield frame
        for is_detected in detected.tolist():
            if not touching:
                environment.advance(detected=is_detected)
                touching = bool(environment.states.signals[GAP][0] <= CAMERA_TO_BUMPER_M)
                frame = faded(frame) if touching else environment.render()
            yield frame
    finally:
        environment.close()


def faded(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same picture ``[H, W, 3]`` in shades of grey."""
    grey = np.rint(frame.mean(axis=-1, keepdims=True)).astype(np.uint8)
    return np.repeat(grey, frame.shape[-1], axis=-1)


if ENVIRONMENT_ID not in gymnasium.registry:
    gymnasium.register(id=ENVIRONMENT_ID, entry_point=f"{__name__}:{BrakingEnv.__name__}")
