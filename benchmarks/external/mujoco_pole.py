"""MuJoCo's inverted pendulum, as gymnasium has it, whose controller goes by what was detected."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.external.motions import Flags, Numbers, Values

POLE = ("x", "th", "xd", "thd")
POLE_START = (0.0, 0.03, 0.0, 0.0)
POLE_GAINS = (0.72, 6.83, 0.92, 1.08)
"""Those of a linear-quadratic regulator, rounded."""
MOST_CONTROL, POLE_LEAN, FRAMES = 3.0, 0.2, 2
"""Limits of the action and of health that InvertedPendulum-v5 has, and its steps of 0.02 s each."""


@dataclass(frozen=True, kw_only=True)
class HeldPole:
    """InvertedPendulum-v5 of gymnasium[mujoco], whose controller goes by the state last detected.

    All rollouts of a batch are stepped by one call of MuJoCo's ``rollout``.

    Attributes:
        base: Log-odds of a detection while the pole does not turn.
        slope: How much less for each rad/s.
    """

    base: float = 1.5
    slope: float = 4.0
    starts: int = 0
    noises: int = 0
    misses: bool = True
    steps: int = 100

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """Its state, how far what is held is off, and the lean that is left, as a share."""
        return {
            "x": (-1.0, 1.0), "th": (-0.3, 0.3), "xd": (-3.0, 3.0), "thd": (-3.0, 3.0),
            "err": (-0.3, 0.3), "rate_err": (-3.0, 3.0), "room": (-1.0, 1.0),
        }  # fmt: skip

    @property
    def spec(self) -> str:
        """There is room left."""
        return f"always[0,{self.steps}] (room >= 0.0)"

    def begin(self, start: Numbers) -> Values:
        """Where every rollout starts; that state is held."""
        state = {name: np.full(len(start), one) for name, one in zip(POLE, POLE_START, strict=True)}
        return _shown(state, {f"held_{name}": value for name, value in state.items()})

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """0.04 s on; once it has failed its state stays."""
        held = {n: np.where(detected, values[n], values[f"held_{n}"]) for n in POLE}
        wanted = np.sum([g * held[n] for g, n in zip(POLE_GAINS, POLE, strict=True)], axis=0)
        before = np.stack([values[n] for n in POLE], axis=-1)
        later = stepped_by_mujoco(before, np.clip(wanted, -MOST_CONTROL, MOST_CONTROL))
        after = np.where(values["room"][:, None] >= 0.0, later, before)
        state = {name: after[:, place] for place, name in enumerate(POLE)}
        return _shown(state, {f"held_{n}": held[n] for n in POLE})

    def logit(self, values: Values) -> Numbers:
        """The faster the pole turns, the less is detected."""
        return self.base - self.slope * np.abs(values["thd"])

    def margin(self, values: Values) -> Numbers:
        """The room that is left."""
        return values["room"]


def _shown(state: Values, held: Values) -> Values:
    errors = {
        "err": state["th"] - held["held_th"],
        "rate_err": state["thd"] - held["held_thd"],
        "room": 1.0 - np.abs(state["th"]) / POLE_LEAN,
    }
    return {**state, **held, **errors}


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
