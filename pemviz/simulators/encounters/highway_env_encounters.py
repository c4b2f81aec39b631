"""Encounters as highway-env environments, and films; this module imports highway-env, and pygame.

Importing it registers the environments with gymnasium::

    import pemviz.simulators.encounters.highway_env_encounters
    gymnasium.make("pemviz-cut-in-v0", render_mode="rgb_array")
"""

from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.observation import ObservationType
from numpy.typing import NDArray

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig, StartChoice
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.errors import ConfigError
from pemviz.simulators.encounters.highway import HighwayEncounters, cars_on_road
from pemviz.simulators.encounters.vectorized import VectorizedEncounters
from pemviz.simulators.highway_env_cars import ScriptedEnv
from pemviz.simulators.latents import begun
from pemviz.types import StateBatch

ENCOUNTERS = {
    "pemviz-braking-encounter-v0": EncounterConfig(logical_scenario="braking"),
    "pemviz-cut-in-v0": EncounterConfig(logical_scenario="cut-in"),
    "pemviz-cut-out-v0": EncounterConfig(logical_scenario="cut-out"),
}
"""By the environment's id."""
LARGEST = 1e6


class SignalsObservation(ObservationType):
    """The logical scenario's signals in their order, float64."""

    env: "EncounterEnv"

    def space(self) -> spaces.Box:
        """Anything finite that is not absurd."""
        return spaces.Box(-LARGEST, LARGEST, (len(self.env.scenario.signals),), np.float64)

    def observe(self) -> FloatArray:
        """The current values."""
        signals = self.env.states.signals
        return np.concatenate([signals[signal.name] for signal in self.env.scenario.signals])


class PerceptionOutcomes(ActionType):
    """For each other car 0, missed, or 1, detected."""

    env: "EncounterEnv"

    def space(self) -> spaces.MultiBinary:
        """An outcome for each, and for the ghost."""
        return spaces.MultiBinary(len(self.env.scenario.slots))

    def act(self, action: Any) -> None:
        """Nothing: the environment tells the ego as it moves on."""


class EncounterEnv(ScriptedEnv):
    """An encounter as ``pemviz.simulators.encounters`` specifies it, stepped with outcomes."""

    def __init__(
        self,
        encounter: EncounterConfig,
        chosen: Sequence[StartChoice] = (),
        tracker: str = NO_TRACKER,
        render_mode: str | None = None,
    ) -> None:
        """Make the environment, in an encounter with medians at the start.

        Args:
            encounter: Parameters, with a logical scenario.
            chosen: Start values with other distributions.
            tracker: As ``ScenarioConfig.tracker``.
            render_mode: ``rgb_array`` to render frames ``[160, 640, 3]`` without a display.
        """
        self.scenario = HighwayEncounters(encounter, tuple(chosen), tracker)
        self.start = np.zeros(self.scenario.latents.start)
        self.on_road = cars_on_road(encounter)
        super().__init__(encounter, shown_m=encounter.farthest_m, render_mode=render_mode)

    def define_spaces(self) -> None:
        """Set our own observation and action types."""
        self.set_spaces(SignalsObservation(self), PerceptionOutcomes(self))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an encounter with start values sampled at random.

        Args:
            seed: Of the start values.
            options: ``start``: their standard normals ``[S]`` instead.
        """
        gymnasium.Env.reset(self, seed=seed)
        given = (options or {}).get("start")
        normals = self.np_random.standard_normal(len(self.start)) if given is None else given
        self.start = np.asarray(normals, dtype=np.float64)
        return super().reset()

    def _reset(self) -> None:
        self.road, self.controlled_vehicles = self.on_road.road, self.on_road.cars[:1]
        self.show(self.scenario.initial(count=1, start=self.start[None]))

    def show(self, states: StateBatch) -> None:
        """Be in the state of one rollout of a back end, ``[1]``."""
        self.states, self.steps = states, int(states.step)
        self.on_road.put(self.scenario.scene(states.signals).of_cars[0].tolist())

    def present(self) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[K]``."""
        return self.scenario.present(self.states.signals)[0]

    def advance(self, detected: BoolArray) -> None:
        """Move one time step on for outcomes ``[K]``, without the costs of observing."""
        self.show(self.scenario.step(self.states, np.asarray(detected, dtype=np.bool_)[None]))

    def _simulate(self, action: Any = None) -> None:
        self.advance(action)

    def _info(self, obs: Any, action: Any = None) -> dict[str, Any]:  # noqa: ARG002
        return {"present": self.present()}


def encounter_frames(
    simulator: VectorizedEncounters, *, detected: BoolArray, start: FloatArray | None = None
) -> Iterator[NDArray[np.uint8]]:
    """Film a rollout with outcomes ``[T-1, K]`` and start ``[S]`` or medians; needs no display.

    Returns:
        T frames, one a state, each ``[160, 640, 3]`` RGB: the road from above, its left side on
        top, the ego blue.

    Raises:
        ConfigError: It measures with errors, whose noise no film is told of.
    """
    if simulator.errors is not None:
        which = simulator.config.logical_scenario
        message = f"film of {which}: must be of encounters without position errors"
        raise ConfigError(message)
    environment = EncounterEnv(simulator.config, simulator.chosen, render_mode="rgb_array")
    first = begun(simulator, count=1, start=None if start is None else start[None])
    try:
        for states in accumulate(detected[:, None], simulator.step, initial=first):
            environment.show(states)
            yield environment.render()
    finally:
        environment.close()


for _name, _encounter in ENCOUNTERS.items():
    if _name not in gymnasium.registry:
        gymnasium.register(
            id=_name,
            entry_point=f"{__name__}:{EncounterEnv.__name__}",
            kwargs={"encounter": _encounter},
        )
