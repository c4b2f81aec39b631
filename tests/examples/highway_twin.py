"""The example with highway-env's cars, with states that are saved: what can be gone on from."""

from typing import Any

import gymnasium as gym
import numpy as np

import pemviz

KEPT = ("heading", "speed", "target_speed", "timer", "speed_index", "crashed")
"""Of each vehicle, beside position, impact and the lane it goes to."""


def vehicles(environment: Any) -> list[Any]:
    return vars(environment.unwrapped)["road"].vehicles


def get_state(environment: Any) -> pemviz.FloatArray:
    rows = [
        (*v.position, *(v.impact if v.impact is not None else (0.0, 0.0)),
         v.target_lane_index[2], *(getattr(v, name, 0.0) for name in KEPT))
        for v in vehicles(environment)
    ]  # fmt: skip
    return np.array(rows).ravel()


def set_state(environment: Any, numbers: pemviz.FloatArray) -> None:
    for v, row in zip(vehicles(environment), numbers.reshape(4, -1), strict=True):
        v.position, v.target_lane_index = row[:2].copy(), ("0", "1", int(row[4]))
        v.impact = row[2:4].copy() if row[2:4].any() else None
        vars(v).update(zip(KEPT, (*row[5:9], int(row[9]), bool(row[10])), strict=True))
        v.on_state_update()


def saving_twin(example: dict[str, Any], cars: Any) -> pemviz.GymnasiumSlotSimulator:
    """The same scenario as the example's episodes, on an environment of its own."""
    made = gym.make("highway_env:highway-v0", config=example["CONFIG"]).unwrapped
    return pemviz.GymnasiumSlotSimulator(
        environment=example["PerceivingEgo"](made), signals=cars.signals, slots=cars.slots,
        observe=cars.observe, reacts_of=cars.reacts_of, states=cars.states, dt_s=cars.dt_s,
        seed=cars.seed, fixed_randomness=True, name=cars.name,
        get_state=get_state, set_state=set_state,
    )  # fmt: skip
