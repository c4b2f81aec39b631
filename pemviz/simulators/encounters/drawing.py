"""An encounter for views: its cars, its lanes, and where the ego believes cars to be."""

from collections.abc import Mapping, Sequence

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters.names import (
    ASIDE,
    COLLIDED,
    EGO_SPEED,
    EGO_X,
    GAP,
    HEADING,
    SPEED,
    of_cars,
    slot_title,
)
from pemviz.simulators.scene import Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.tracking.tracker import Tracker
from pemviz.types import StateBatch


def encounter_cars(config: EncounterConfig, cars: Sequence[str]) -> tuple[SceneCar, ...]:
    """The ego and the other cars, all of one size."""
    size = (config.car_length_m, config.car_width_m, config.car_height_m)
    others = (SceneCar(slot_title(car), *size, slot=slot_title(car)) for car in cars)
    return (SceneCar("ego", *size), *others)


def lanes(config: EncounterConfig) -> Road:
    """Three, the ego's in the middle."""
    return Road(tuple(config.lane_width_m * place for place in (-1.5, -0.5, 0.5, 1.5)))


def scene_states(
    config: EncounterConfig, cars: Sequence[str], signals: Mapping[str, FloatArray]
) -> SceneStates:
    """Where the cars are, of signals ``[...]``."""
    ego_m, ego_mps = np.asarray(signals[EGO_X]), np.asarray(signals[EGO_SPEED])
    ahead_m = of_cars(GAP, cars, signals) + config.car_length_m
    none = np.zeros_like(ego_m)

    def together(own: FloatArray, others: FloatArray) -> FloatArray:
        return np.moveaxis(np.concatenate([own[None], others]), 0, -1)

    x_m = together(ego_m, ego_m + ahead_m)
    return SceneStates(
        x_m=x_m,
        y_m=together(none, of_cars(ASIDE, cars, signals)),
        heading_rad=together(none, of_cars(HEADING, cars, signals)),
        speed_mps=together(ego_mps, of_cars(SPEED, cars, signals)),
        present=np.ones(x_m.shape, dtype=np.bool_),
        collided=np.asarray(signals[COLLIDED]) > 0.0,
    )


def scene_tracks(
    config: EncounterConfig, cars: Sequence[str], tracker: Tracker | None, states: StateBatch
) -> SceneTracks:
    """Where the controller believes cars to be, ``[..., K]``.

    States hold the tracks after the outcomes of the step that led to them: where a filter knows
    speeds, they are where it predicts cars to be. Without a tracker there are none.
    """
    ego_m = np.asarray(states.signals[EGO_X])[..., None]
    if tracker is None:
        none = np.zeros((*ego_m.shape[:-1], len(cars)))
        return SceneTracks(none, none, none, none, none > 0.0)
    tracks = tracker.state(states.memory, slots=len(cars))
    motion = tracker.filter.predicted(tracks.motion, dt_s=config.dt_s)
    sd_m = np.sqrt(motion.variances[..., 0])
    return SceneTracks(
        x_m=ego_m + config.car_length_m + motion.position_m[..., 0],
        y_m=motion.position_m[..., 1],
        x_sd_m=sd_m,
        y_sd_m=sd_m,
        confirmed=tracks.confirmed,
    )
