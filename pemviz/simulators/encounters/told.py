"""What the controller is told of the other cars after a step's outcomes, with a tracker or without.

Arrays have a row for each other car, ``[K, N]``.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.simulators.encounters.ego import Told
from pemviz.simulators.encounters.names import by_car
from pemviz.simulators.tracking.tracker import Tracker

MEASURED_CLOSING = "measured_closing"
"""Memory: closing speed at a car's last hit, where the tracker's filter has no speeds."""


def nothing_told(tracker: Tracker | None, cars: Sequence[str], count: int) -> dict[str, AnyArray]:
    """What states remember before any outcome, arrays ``[count]``."""
    if tracker is None:
        return {}
    none = np.zeros((len(cars), count))
    closing = {} if has_speeds(tracker) else by_car(MEASURED_CLOSING, cars, none)
    return {**tracker.memory(tracker.start(count, slots=len(cars))), **closing}


def told_after(
    tracker: Tracker | None,
    cars: Sequence[str],
    memory: Mapping[str, AnyArray],
    measured: Told,
) -> tuple[Told, dict[str, AnyArray]]:
    """What the controller is told, and what the next states remember.

    Args:
        tracker: Between perception and controller, if there is one.
        cars: Names of the K other cars.
        memory: Of the states in which perception acted.
        measured: Which cars it reports, and what it measures of those.
    """
    if tracker is None:
        return measured, {}
    hits = measured.there
    before = tracker.state(memory, slots=len(cars))
    positions_m = np.stack([measured.gap_m.T, measured.aside_m.T], axis=-1)
    tracks = tracker.update(before, hits.T, positions_m)
    if has_speeds(tracker):
        closing_mps, kept = -tracks.speed_mps[..., 0].T, {}
    else:
        held_mps = np.stack([memory[f"{MEASURED_CLOSING}_{car}"] for car in cars])
        closing_mps = np.where(hits, measured.closing_mps, held_mps)
        kept = by_car(MEASURED_CLOSING, cars, closing_mps)
    told = Told(
        there=tracks.confirmed.T,
        gap_m=tracks.position_m[..., 0].T,
        aside_m=tracks.position_m[..., 1].T,
        closing_mps=closing_mps,
    )
    return told, {**tracker.memory(tracks), **kept}


def has_speeds(tracker: Tracker) -> bool:
    """Whether the tracker itself tells how fast cars move."""
    return "speed_mps" in tracker.filter.keeps
