"""highway-env's own ``merge-v0`` as a black box: an ego passes a ramp, acting on what it tracks.

The road, the other cars and how they drive (IDM and MOBIL, which also react to the ego) are
highway-env's. Three cars are on the road; one on the ramp merges in front of the ego, or behind it.
Their lanes are fixed here, while places (+-5 m) and speeds (+-1 m/s) are sampled at the start as
merge-v0 samples them. Nothing of the environment can be saved; one step of it, of 0.2 s and three
of its simulation steps, is one step of a rollout.

Perception
    looks ahead: cars whose rear is in front of the ego's front, nearer than 100 m and within 60
    degrees of straight ahead, are its obstacles; a slot each, absent while out of view. What they
    hide of each other is left out. A detection measures exactly where the car is.
Ego
    wants 30 m/s, stays in its lane, and passes nobody: not those on the ramp, who are about to
    merge, nor on the right those of the left lane. It acts on the cars that it tracks within 6 m to
    either side, where they are or will be in a second by the track's speed. For one nearer than
    10 m and 1.2 s of driving it brakes (the environment's action SLOWER, 4 to 12 m/s^2); for one
    nearer than 10 m and 1.6 s it keeps its target speed (IDLE); else it speeds up (FASTER). Without
    a tracker it acts on the detections of the step alone, whose cars have no speed.
Rules
    stand in preset ``merge``: no collision; a safe distance to the car in front, if not now then
    within 3 s, as after a cut-in (Maierhofer et al. 2020, R_G1); no hard braking but for a car that
    is near and beside or before the ego (R_G2).
"""

from pemviz.types import Signal

CARS = ("front", "middle", "rear", "ramp")
"""In the environment's own order; the first three are named by where they start on the road."""
STATES = 61
DT_S = 0.2
LANES = (0, 1, 0)
"""Of the cars on the road; merge-v0 samples each anew, 0 the left one and 1 the ego's."""
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
    """What is random: gap to each car on the road, below 0 behind the ego, and its speed."""
    found: list[Signal] = []
    for car, along_m, speed_mps in ON_THE_ROAD:
        gap_m = along_m - EGO_START_M - CAR_LENGTH_M
        gaps_m = gap_m - PLACE_SPREAD_M, gap_m + PLACE_SPREAD_M
        speeds_mps = speed_mps - SPEED_SPREAD_MPS, speed_mps + SPEED_SPREAD_MPS
        found.append(Signal(f"{car}_gap", f"{car}_gap_m", "m", *gaps_m))
        found.append(Signal(f"{car}_speed", f"{car}_speed_mps", "m/s", *speeds_mps))
    return tuple(found)


def merge_signals() -> tuple[Signal, ...]:
    """What specifications may name; of each car gap, offset to the left, speed and heading."""
    found = [
        Signal("ego_x", "ego_x_m", "m", 0.0, 460.0),
        Signal("ego_speed", "ego_speed_mps", "m/s", 0.0, 40.0),
        Signal("ego_acceleration", "ego_acceleration_mps2", "m/s^2", -15.0, 15.0),
        Signal("clearance", "clearance_m", "m", -50.0, 50.0),
        Signal("safety_margin", "safety_margin_m", "m", -100.0, 100.0),
        Signal("path_gap", "path_gap_m", "m", -100.0, 100.0),
        Signal("collided", "collided", "", -1.0, 1.0),
    ]
    for car in CARS:
        found += [
            Signal(f"gap_{car}", f"gap_{car}_m", "m", -150.0, 150.0),
            Signal(f"aside_{car}", f"aside_{car}_m", "m", -15.0, 15.0),
            Signal(f"speed_{car}", f"speed_{car}_mps", "m/s", 0.0, 40.0),
            Signal(f"heading_{car}", f"heading_{car}_rad", "rad", -1.0, 1.0),
        ]
    return tuple(found)
