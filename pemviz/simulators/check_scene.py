"""What a simulator must keep to that tells views where its cars are."""

from typing import Any, NoReturn

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.errors import ConfigError
from pemviz.faults import told
from pemviz.simulators.scene import DrawsScene, DrawsTracks, Road, SceneCar, SceneStates
from pemviz.types import StateBatch

LEAST_LINES = 2


def check_scene(simulator: Any, states: StateBatch, where: str) -> None:
    """Cars, road and shapes at ``states [N]``, where the simulator offers them.

    Raises:
        ConfigError: One line, which begins with ``where``.
    """
    slots = tuple(slot.name for slot in getattr(simulator, "slots", ()))
    if isinstance(simulator, DrawsScene):
        _check_cars(simulator.scene_cars, slots, where)
        _check_road(simulator.road, where)
        _check_places(simulator, states, where)
    if isinstance(simulator, DrawsTracks):
        _check_tracks(simulator, states, slots=max(len(slots), 1), where=where)


def _check_cars(cars: Any, slots: tuple[str, ...], where: str) -> None:
    if not isinstance(cars, tuple) or not cars or not all(isinstance(c, SceneCar) for c in cars):
        _refuse(f"{where}: scene_cars must be a tuple of pemviz.SceneCar, the ego first")
    for car in cars:
        if not isinstance(car.name, str) or not car.name.strip() or not car.name.isprintable():
            _refuse(f"{where}: a car of the scene is named {car.name!r}: must be a line of text")
        sizes = (car.length_m, car.width_m, car.height_m)
        if not all(isinstance(size, int | float) and 0.0 < size < np.inf for size in sizes):
            _refuse(f"{where}: car {car.name!r} has the sizes {sizes}: must be above 0 and finite")
        if car.slot is not None and slots and car.slot not in slots:
            _refuse(
                f"{where}: car {car.name!r} has the slot {car.slot!r}: must be one of "
                f"{', '.join(slots)}"
            )
    names = [car.name for car in cars]
    if len(set(names)) < len(names):
        _refuse(f"{where}: the scene's cars are named {names}: each must have a name of its own")


def _check_road(road: Any, where: str) -> None:
    if not isinstance(road, Road):
        _refuse(f"{where}: road is a {type(road).__name__}: must be a pemviz.Road")
    try:
        edges_m = np.asarray(road.lane_edges_m, dtype=np.float64)
    except (TypeError, ValueError):
        edges_m = np.empty(0)
    fine = edges_m.ndim == 1 and edges_m.size >= LEAST_LINES and np.isfinite(edges_m).all()
    if not fine or not (np.diff(edges_m) > 0.0).all():
        _refuse(
            f"{where}: road has lane_edges_m = {road.lane_edges_m!r}: must be at least "
            f"{LEAST_LINES} finite numbers, ascending"
        )


def _check_places(simulator: Any, states: StateBatch, where: str) -> None:
    cars, count = len(simulator.scene_cars), states.shape[0]
    for asked, shape in ((states, (count,)), (_twice(states), (count, 2))):
        try:
            drawn = simulator.scene(asked.signals)
        except BaseException as error:  # the user's code may raise anything
            _refuse_raised(f"{where}: scene", shape, error)
        if not isinstance(drawn, SceneStates):
            _refuse(f"{where}: scene gives a {type(drawn).__name__}: must be a pemviz.SceneStates")
        of_cars = (*shape, cars)
        _check_array(drawn.collided, "scene: collided", shape, np.bool_, where)
        _check_array(drawn.present, "scene: present", of_cars, np.bool_, where)
        for name in ("x_m", "y_m", "heading_rad", "speed_mps"):
            values = getattr(drawn, name)
            _check_array(values, f"scene: {name}", of_cars, np.float64, where)
            if not np.isfinite(values[drawn.present]).all():
                _refuse(f"{where}: scene: {name} must be finite wherever a car is present")


def _check_tracks(simulator: Any, states: StateBatch, *, slots: int, where: str) -> None:
    count = states.shape[0]
    for asked, shape in ((states, (count, slots)), (_twice(states), (count, 2, slots))):
        try:
            drawn = simulator.scene_tracks(asked)
        except BaseException as error:  # the user's code may raise anything
            _refuse_raised(f"{where}: scene_tracks", shape[:-1], error)
        confirmed = getattr(drawn, "confirmed", None)
        _check_array(confirmed, "scene_tracks: confirmed", shape, np.bool_, where)
        for name in ("x_m", "y_m", "x_sd_m", "y_sd_m"):
            values = getattr(drawn, name, None)
            _check_array(values, f"scene_tracks: {name}", shape, np.float64, where)
            known = np.asarray(values)[np.asarray(confirmed)]
            if not np.isfinite(known).all() or (name.endswith("_sd_m") and (known < 0.0).any()):
                least = " and at least 0" if name.endswith("_sd_m") else ""
                _refuse(f"{where}: scene_tracks: {name} of a track must be finite{least}")


def _check_array(values: object, what: str, shape: tuple[int, ...], kind: type, where: str) -> None:
    found = np.asarray(values)
    if found.shape != shape or found.dtype != kind:
        _refuse(
            f"{where}: {what} is {found.dtype} of shape {found.shape} for signals of shape "
            f"{shape if 'collided' in what else shape[:-1]}: must be {np.dtype(kind)} of shape "
            f"{shape}"
        )


def _twice(states: StateBatch) -> StateBatch:
    def doubled(values: AnyArray) -> AnyArray:
        return np.stack([values, values], axis=-1)

    return StateBatch(
        step=states.step,
        signals={name: doubled(values) for name, values in states.signals.items()},
        memory={name: doubled(values) for name, values in states.memory.items()},
    )


def _refuse_raised(what: str, shape: tuple[int, ...], error: BaseException) -> NoReturn:
    message = f"{what} raises {told(error)} (for signals of shape {shape})"
    raise ConfigError(message) from error


def _refuse(message: str) -> NoReturn:
    raise ConfigError(message)
