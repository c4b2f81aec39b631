"""The braking scenario on highway-env, and films of its rollouts.

highway-env itself is imported when the first scene is built, not with this module.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.scenario import (
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
    SPEED_ERROR_INTEGRAL,
    BrakingScenario,
)
from pemviz.types import StateBatch

if TYPE_CHECKING:
    from pemviz.simulators.braking.highway_env_scenario import BrakingEnv

SCENES_KEPT = 8


@dataclass(frozen=True)
class HighwaySimulator(BrakingScenario):
    """Each rollout of a batch in turn is loaded into a highway-env scene, stepped, read back."""

    @property
    def name(self) -> str:
        """Back end's name."""
        return "highway-env"

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The states one time step on, for outcomes ``[N]`` and, with errors, noise ``[N, 1]``."""
        from pemviz.simulators.braking.highway_env_scenario import BrakingState  # noqa: PLC0415  pygame

        scene = _scene(self.config, get_ident())
        reached: list[BrakingState] = []
        perceived = self.perceived(states, detected, noise)
        columns = (
            np.full(detected.shape, states.step),
            states.signals[GAP],
            states.signals[EGO_SPEED],
            states.signals[LEAD_SPEED],
            states.memory[SPEED_ERROR_INTEGRAL],
            perceived.present,
            perceived.gap_m,
        )
        for *state, present, perceived_m in zip(
            *(column.tolist() for column in columns), strict=True
        ):
            scene.load(BrakingState(*state))
            scene.move(present=present, gap_m=perceived_m)
            reached.append(scene.state)
        table = np.array(reached, dtype=np.float64).reshape(-1, len(BrakingState._fields))
        _, gap_m, ego_mps, lead_mps, integral_m = table.T
        return StateBatch(
            step=states.step + 1,
            signals={GAP: gap_m, EGO_SPEED: ego_mps, LEAD_SPEED: lead_mps},
            memory={SPEED_ERROR_INTEGRAL: integral_m, **perceived.memory},
        )


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
    from pemviz.simulators.braking.highway_env_scenario import BrakingEnv  # noqa: PLC0415  pygame

    environment = BrakingEnv(config, render_mode="rgb_array")
    try:
        frame, touching = environment.render(), False
        yield frame
        for is_detected in detected.tolist():
            if not touching:
                environment.advance(detected=is_detected)
                touching = environment.state.gap_m <= CAMERA_TO_BUMPER_M
                frame = faded(frame) if touching else environment.render()
            yield frame
    finally:
        environment.close()


def faded(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same picture ``[H, W, 3]`` in shades of grey."""
    grey = np.rint(frame.mean(axis=-1, keepdims=True)).astype(np.uint8)
    return np.repeat(grey, frame.shape[-1], axis=-1)


@lru_cache(maxsize=SCENES_KEPT)
def _scene(config: ScenarioConfig, thread: int) -> "BrakingEnv":  # noqa: ARG001
    """A scene to work in. Its content outlives no call, so sharing is safe within a thread."""
    from pemviz.simulators.braking.highway_env_scenario import BrakingEnv  # noqa: PLC0415  pygame

    return BrakingEnv(config)
