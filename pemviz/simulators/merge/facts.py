"""What the merge's environment and the simulator around it both know."""

from pemviz.types import Signal

CARS = ("front", "middle", "rear", "ramp")
"""In the environment's own order; the first three are named by where they start on the road."""
STATES = 61
DT_S = 0.2
LANES = (0, 1, 0)
"""Of the cars on the road; merge-v0 draws each anew, 0 the left one and 1 the ego's."""
LATENTS = 6
"""Place and speed of each of the cars on the road."""
ON_THE_ROAD = (("front", 90.0, 29.0), ("middle", 70.0, 31.0), ("rear", 5.0, 31.5))
"""Where merge-v0 has each on average, along the road [m], and how fast [m/s]."""
EGO_START_M = 30.0
PLACE_SPREAD_M, SPEED_SPREAD_MPS = 5.0, 1.0
"""Uniformly so much to either side."""

CAR_LENGTH_M, CAR_WIDTH_ROAD_M = 5.0, 2.0
"""highway-env's cars, by which they collide."""
BESIDE_M = 6.0
OWN_SIGNALS = ("gap", "aside", "speed", "heading")


def merge_starts() -> tuple[Signal, ...]:
    """What is drawn: gap to each car on the road, below 0 behind the ego, and its speed."""
    found: list[Signal] = []
    for car, along_m, speed_mps in ON_THE_ROAD:
        gap_m = along_m - EGO_START_M - CAR_LENGTH_M
        least_m, most_m = gap_m - PLACE_SPREAD_M, gap_m + PLACE_SPREAD_M
        least_mps, most_mps = speed_mps - SPEED_SPREAD_MPS, speed_mps + SPEED_SPREAD_MPS
        found += [
            Signal(name=f"{car}_gap", key=f"{car}_gap_m", unit="m", low=least_m, high=most_m),
            Signal(
                name=f"{car}_speed",
                key=f"{car}_speed_mps",
                unit="m/s",
                low=least_mps,
                high=most_mps,
            ),
        ]
    return tuple(found)


def merge_signals() -> tuple[Signal, ...]:
    """What specifications may name; of each car gap, offset to the left, and speed."""
    own = (
        Signal(name="ego_x", key="ego_x_m", unit="m", low=0.0, high=460.0),
        Signal(name="ego_speed", key="ego_speed_mps", unit="m/s", low=0.0, high=40.0),
        Signal(
            name="ego_acceleration", key="ego_acceleration_mps2", unit="m/s^2", low=-15.0, high=15.0
        ),
        Signal(name="clearance", key="clearance_m", unit="m", low=-50.0, high=50.0),
        Signal(name="safety_margin", key="safety_margin_m", unit="m", low=-100.0, high=100.0),
        Signal(name="path_gap", key="path_gap_m", unit="m", low=-100.0, high=100.0),
        Signal(name="collided", key="collided", unit="", low=-1.0, high=1.0),
    )
    of_cars = tuple(
        signal
        for car in CARS
        for signal in (
            Signal(name=f"gap_{car}", key=f"gap_{car}_m", unit="m", low=-150.0, high=150.0),
            Signal(name=f"aside_{car}", key=f"aside_{car}_m", unit="m", low=-15.0, high=15.0),
            Signal(name=f"speed_{car}", key=f"speed_{car}_mps", unit="m/s", low=0.0, high=40.0),
            Signal(name=f"heading_{car}", key=f"heading_{car}_rad", unit="rad", low=-1.0, high=1.0),
        )
    )
    return (*own, *of_cars)
