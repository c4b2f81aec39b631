"""A small scenario with a scene: a car cuts in ahead of the ego, another drives on."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.scene import Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.slots import Slot
from pemviz.simulators.tracking.tracker import Tracker
from pemviz.types import Signal, StateBatch

LENGTH_M, WIDTH_M, LANE_M = 5.0, 2.0, 3.5
BRAKE_MPS2, DRIFT_MPS = 7.0, 1.2
SPREAD_M = (0.8, 0.3)
SIGNALS = (
    ("ego_x", 200.0), ("ego_speed", 25.0), ("gap_lead", 60.0), ("gap_cutter", 60.0),
    ("aside_cutter", 4.0), ("collided", 1.0), ("impact_speed", 25.0),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CutIn:
    """The ego brakes while it tracks a car in its lane nearer than 30 m; at contact all stands."""

    states: int = 41
    dt_s: float = 0.1
    name: str = "toy-cut-in"
    tracker: Tracker = Tracker(dt_s=0.1, hits=2, window=3)  # noqa: RUF009  frozen

    signals = tuple(Signal(name, f"{name}_si", "", -1.0, high) for name, high in SIGNALS)
    slots = (Slot("lead", signals=("gap_lead",)), Slot("cutter", signals=("gap_cutter",)))
    road = Road(lane_edges_m=(-1.75, 1.75, 5.25))
    scene_cars = (
        SceneCar("ego", LENGTH_M, WIDTH_M),
        SceneCar("lead", LENGTH_M, WIDTH_M, slot="lead"),
        SceneCar("cutter", LENGTH_M, WIDTH_M, slot="cutter"),
    )

    def initial(self, *, count: int) -> StateBatch:
        at = {"ego_speed": 20.0, "gap_lead": 45.0, "gap_cutter": 16.0, "aside_cutter": LANE_M}
        signals = {name: np.full(count, at.get(name, 0.0)) for name, _ in SIGNALS}
        memory = self.tracker.memory(self.tracker.start(count, slots=2))
        return StateBatch(step=np.zeros((), dtype=np.int64), signals=signals, memory=memory)

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        s, dt_s = states.signals, self.dt_s
        tracks = self.tracker.update(self.tracker.state(states.memory, slots=2), detected)
        brakes = (tracks.confirmed & self.reacts(s)).any(axis=-1)
        stands = s["collided"] > 0.0
        speed = np.clip(s["ego_speed"] - np.where(brakes, BRAKE_MPS2, 0.0) * dt_s, 0.0, None)
        gaps = {n: s[n] + np.where(stands, 0.0, 12.0 - s["ego_speed"]) * dt_s
                for n in ("gap_lead", "gap_cutter")}  # fmt: skip
        drift_m = np.where(stands, 0.0, DRIFT_MPS * dt_s)
        aside = np.clip(s["aside_cutter"] - drift_m, 0.0, None)
        touches = (gaps["gap_cutter"] <= 0.0) & (aside < WIDTH_M) | (gaps["gap_lead"] <= 0.0)
        first = touches & ~stands
        signals = {
            "ego_x": s["ego_x"] + s["ego_speed"] * dt_s * ~stands,
            "ego_speed": np.where(stands | touches, 0.0, speed),
            **gaps,
            "aside_cutter": aside,
            "collided": (stands | touches).astype(np.float64),
            "impact_speed": np.where(first, s["ego_speed"] - 12.0, s["impact_speed"]),
        }
        return StateBatch(states.step + 1, signals, self.tracker.memory(tracks))

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return np.stack([signals["gap_lead"], signals["gap_cutter"]], axis=-1)[..., None]

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        return np.stack([signals["gap_lead"] < 44.0, signals["gap_cutter"] > -4.0], axis=-1)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        near = np.stack([signals["gap_lead"], signals["gap_cutter"]], axis=-1) < 30.0
        in_lane = np.abs(signals["aside_cutter"]) < 2.5
        return near & np.stack([np.ones_like(in_lane), in_lane], axis=-1)

    def scene(self, signals: Mapping[str, FloatArray]) -> SceneStates:
        ego_x, aside = signals["ego_x"], signals["aside_cutter"]
        x = [ego_x, *(ego_x + LENGTH_M + signals[n] for n in ("gap_lead", "gap_cutter"))]
        moves = (aside > 0.0) & (aside < LANE_M)
        zeros, stands = np.zeros_like(ego_x), signals["collided"] > 0.0
        others = np.where(stands, 0.0, 12.0)
        return SceneStates(
            x_m=np.stack(x, axis=-1),
            y_m=np.stack([zeros, zeros, aside], axis=-1),
            heading_rad=np.stack(
                [zeros, zeros, -1.0 * moves * np.arctan(DRIFT_MPS / 12.0)], axis=-1
            ),
            speed_mps=np.stack([signals["ego_speed"], others, others], axis=-1),
            present=np.ones((*ego_x.shape, 3), dtype=np.bool_),
            collided=stands,
        )

    def scene_tracks(self, states: StateBatch) -> SceneTracks:
        drawn = self.scene(states.signals)
        confirmed = self.tracker.state(states.memory, slots=2).confirmed
        spread = [np.full(confirmed.shape, sd_m) for sd_m in SPREAD_M]
        return SceneTracks(drawn.x_m[..., 1:], drawn.y_m[..., 1:], *spread, confirmed)


class CameraOfTwo:
    """P(detected) falls with the gap."""

    def logit(self, salient: FloatArray) -> FloatArray:
        return 2.0 - 0.03 * salient[..., 0]
