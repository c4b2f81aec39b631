"""MuJoCo's inverted pendulum, as gymnasium has it, whose controller goes by what was detected."""

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.external.held import HeldState
from benchmarks.external.motions import Numbers, Values

POLE_RANGES = {"x": (-1.0, 1.0), "th": (-0.3, 0.3), "xd": (-3.0, 3.0), "thd": (-3.0, 3.0)}
POLE_START = (0.0, 0.03, 0.0, 0.0)
MOST_CONTROL, POLE_LEAN, FRAMES = 3.0, 0.2, 2
"""Limits of the action and of health that InvertedPendulum-v5 has, and its steps of 0.02 s each."""


@dataclass(frozen=True, kw_only=True)
class HeldPole(HeldState):
    """InvertedPendulum-v5 of gymnasium[mujoco], 0.04 s a step, likewise.

    All rollouts of a batch are stepped by one call of MuJoCo's ``rollout``. The gains are those of
    a linear-quadratic regulator, rounded.
    """

    base: float = 1.5
    slope: float = 4.0
    steps: int = 100
    ranges = POLE_RANGES
    first = POLE_START
    gains = (0.72, 6.83, 0.92, 1.08)

    def later(self, values: Values, wanted: Numbers) -> Values:
        """By MuJoCo."""
        before = np.stack([values[name] for name in self.ranges], axis=-1)
        after = stepped_by_mujoco(before, np.clip(wanted, -MOST_CONTROL, MOST_CONTROL))
        return {name: after[:, place] for place, name in enumerate(self.ranges)}

    def room(self, state: Values) -> Numbers:
        """To the lean that ends an episode."""
        return 1.0 - np.abs(state["th"]) / POLE_LEAN


@cache
def _model() -> tuple[Any, Any]:
    mujoco: Any = import_module("mujoco")
    root = Path(import_module("gymnasium").__file__ or "").parent
    file = root / "envs" / "mujoco" / "assets" / "inverted_pendulum.xml"
    model = mujoco.MjModel.from_xml_path(str(file))
    return model, mujoco.MjData(model)


def stepped_by_mujoco(state: Numbers, control: Numbers) -> Numbers:
    """Positions and velocities ``[N, 4]`` after an action ``[N]`` is held for two steps of 0.02 s.

    Nothing but these is carried from one step to the next, so that batches have no say.
    """
    rollout: Any = import_module("mujoco.rollout").rollout
    model, data = _model()
    if len(state) == 0:
        return state
    timed = np.concatenate([np.zeros((len(state), 1)), state], axis=1)
    held = np.repeat(control[:, None, None], FRAMES, axis=1)
    reached, _ = rollout(model, [data], timed, held)
    return reached[:, -1, 1:]
