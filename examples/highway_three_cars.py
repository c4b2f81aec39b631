"""highway-env's own highway-v0 with three cars: how likely does the ego come too near to one?"""

from typing import Any

import gymnasium as gym
import numpy as np

import pemviz

CONFIG = {
    "vehicles_count": 3, "lanes_count": 2, "simulation_frequency": 5, "policy_frequency": 5,
    "observation": {"type": "AttributesObservation", "attributes": ["time"]}, "duration": 1e9,
    "action": {"type": "DiscreteMetaAction", "lateral": False, "target_speeds": range(0, 31, 5)},
}  # fmt: skip
SLOTS = tuple(pemviz.Slot(f"car {n}", signals=(f"ahead_{n}", f"aside_{n}")) for n in (1, 2, 3))
NAMES = ("ego_speed", "clearance", *(name for slot in SLOTS for name in slot.signals))


def in_the_way(signals: Any) -> Any:  # the cars for which the ego brakes, if it perceives them
    ahead_m, aside_m = (np.stack([signals[s.signals[i]] for s in SLOTS], axis=-1) for i in (0, 1))
    near = ahead_m < 10.0 + 1.2 * np.asarray(signals["ego_speed"])[..., None]
    return (ahead_m > 0.0) & near & (np.abs(aside_m) < 2.0)


class PerceivingEgo(gym.Wrapper):  # wants to go fast; its action: which of the cars it perceives
    def reset(self, **options: Any) -> Any:
        return self.look(self.env.reset(**options)), {}

    def step(self, action: Any) -> Any:
        self.env.step(0 if np.any(in_the_way(self.look()) & (action > 0)) else 2)  # SLOWER, FASTER
        return self.look(), 0.0, vars(self.unwrapped)["road"].vehicles[0].crashed, False, {}

    def look(self, _: Any = None) -> dict[str, float]:
        ego, *cars = vars(self.unwrapped)["road"].vehicles
        away = np.array([car.position - ego.position for car in cars])
        clearance = np.max(np.abs(away) - (5.0, 2.0), axis=1).min()  # less a car's size
        return dict(zip(NAMES, (ego.speed, clearance, *away.ravel()), strict=True))


class Camera:
    def logit(self, salient: pemviz.FloatArray) -> pemviz.FloatArray:
        return 1.0 - 0.02 * salient[..., 0]  # sees a car the better the nearer it is


if __name__ == "__main__":
    cars = pemviz.GymnasiumSlotEpisodes(
        environment=PerceivingEgo(gym.make("highway_env:highway-v0", config=CONFIG).unwrapped),
        signals=tuple(pemviz.Signal(name, name, "", -100.0, 100.0) for name in NAMES),
        slots=SLOTS,
        observe=dict,
        reacts_of=in_the_way,
        states=31,
        dt_s=0.2,
        seed=31,
        fixed_randomness=True,  # the answer is for this traffic
        name="highway-v0",
    )  # reset and stepped: nothing of highway-v0 need be saved
    config = pemviz.ExperimentConfig(spec="always[0,30] (clearance >= 1.0)", method="mixture")
    experiment = pemviz.build_experiment(config, simulator=cars, pem=Camera())
    worst = pemviz.LeastRobust()
    print(pemviz.summary_text(pemviz.run(experiment, observers=[worst])), worst, sep="\n")
