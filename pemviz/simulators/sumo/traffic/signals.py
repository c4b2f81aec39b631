"""What specifications may name in traffic."""

from functools import cache

from pemviz.simulators.sumo.traffic.facts import NOBODY_M, OF_SLOT, signal_names
from pemviz.types import Signal

OF_EGO = {
    "distance": ("m", 0.0, 10_000.0),
    "ego_speed": ("m/s", 0.0, 60.0),
    "ego_acceleration": ("m/s^2", -15.0, 15.0),
    "clearance": ("m", -20.0, NOBODY_M),
    "safe_distance": ("m", -300.0, NOBODY_M),
    "needless_deceleration": ("m/s^2", 0.0, 20.0),
    "collided": ("", -1.0, 1.0),
    "wanted_speed": ("m/s", 0.0, 100.0),
}
OF_CAR = {
    "gap": ("m", -150.0, NOBODY_M),
    "aside": ("m", -100.0, 100.0),
    "speed": ("m/s", -60.0, 60.0),
    "heading": ("rad", -4.0, 4.0),
}
KEYS = {"m": "_m", "m/s": "_mps", "m/s^2": "_mps2", "rad": "_rad", "": ""}


@cache
def traffic_signals() -> tuple[Signal, ...]:
    """Those of the ego, then of the cars around it."""
    found: list[Signal] = []
    for name in signal_names():
        kind = name.split("_")[0]
        is_of_car = name not in OF_EGO and kind in OF_SLOT
        unit, low, high = OF_CAR[kind] if is_of_car else OF_EGO[name]
        found.append(Signal(name=name, key=f"{name}{KEYS[unit]}", unit=unit, low=low, high=high))
    return tuple(found)
