"""Error models as a plain table, for a simulator of one's own: CSV, or JSON with its notes."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pemviz.pem.exchange.averages import (
    Averages,
    AxisAverages,
    Obstacles,
    averages,
    by_class_and_occlusion,
)
from pemviz.pem.exchange.unsaid import LEAST_WITH_SD
from pemviz.pem.models.position_errors import PositionErrorModel
from pemviz.pem.models.protocol import Pem

DIGITS = 6
DISTANCE = (
    "from_m and to_m: over the ground, to the nearest point of the obstacle's box, from a point "
    "{ahead:g} m behind the camera"
)
MEANS = (
    "P(missed | before) = p + (m - p) exp(-h / memory_time_s), h seconds on, m = 1 after a miss, "
    "0 after a hit; P(missed | u) = Phi(Phi^-1(p) sqrt(1 + frailty^2) + frailty u) with one "
    "standard normal u an obstacle; errors: reported minus true, with the correlation "
    "c + (1 - c) exp(-h / tau), c the lasting_share, tau the memory_time_s of theirs"
)


def plain_rows(
    pem: Pem, obstacles: Obstacles, *, edges_m: Sequence[float], errors: PositionErrorModel | None
) -> list[dict[str, Any]]:
    """A row for each class, occlusion level and bin that has obstacles."""
    rows: list[dict[str, Any]] = []
    for kind, occlusion, chosen in by_class_and_occlusion(obstacles):
        table = averages(pem, chosen, edges_m=edges_m, errors=errors)
        place = table.bin_of(chosen.distance_m)
        for index in np.flatnonzero(table.rows).tolist():
            low_m, high_m = table.bins[index]
            here = {"class": kind, "occlusion": occlusion, "from_m": low_m, "to_m": high_m}
            if chosen.detected is not None:
                here["rows"] = int(table.rows[index])
                here["missed"] = int(np.count_nonzero(~chosen.detected[place == index]))
            values = _values(table, index)
            rows.append(here | {name: _shortened(value) for name, value in values.items()})
    return rows


def _values(table: Averages, index: int) -> dict[str, float | None]:
    errors = {
        f"{axis.name}_error_{name}": value
        for axis in table.axes
        for name, value in _of_axis(axis, index).items()
    }
    return {
        "p_missed": float(table.miss[index]),
        "memory_time_s": table.memory.tau_s,
        "frailty": table.memory.frailty,
        **errors,
    }


def _of_axis(axis: AxisAverages, index: int) -> dict[str, float | None]:
    unit = "mps" if axis.name == "speed" else "m"
    has_sd = axis.degrees_of_freedom > LEAST_WITH_SD
    return {
        f"mean_{unit}": float(axis.mean[index]),
        f"sd_{unit}": float(axis.deviation[index]) if has_sd else None,
        f"half_width_68_{unit}": float(axis.half_width[index]),
        "lasting_share": axis.memory.lasting_share,
        "memory_time_s": axis.memory.tau_s,
    }


def _shortened(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.{DIGITS}g}")


def plain_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as CSV."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
