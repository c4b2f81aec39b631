"""Units of a table's columns: what is stated is converted, and what cannot be metres is refused.

A column of a log may say its unit; without one it is taken in the table's, which its name ends
with. Whether that can be is judged by sizes of obstacles of a class, distances and angles: a value
that no road user has, and that another unit would explain, is an error in the log's mapping.
"""

from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import ConfigError, PemError
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN

Unit = Literal["m", "cm", "mm", "km", "ft", "in", "rad", "deg", "s", "ms", "us", "ns", "%"]
IN_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "in": 0.0254}
IN_RADIANS = {"rad": 1.0, "deg": np.pi / 180.0}
IN_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
IN_SHARES = {"%": 0.01}
WORDS = {
    **{"m": "metres", "cm": "centimetres", "mm": "millimetres", "km": "kilometres", "ft": "feet"},
    **{"in": "inches", "deg": "degrees", "%": "per cent"},
}
ENDINGS: Mapping[str, Mapping[str, float]] = {
    "_m": IN_METRES,
    "_rad": IN_RADIANS,
    "_s": IN_SECONDS,
}
"""What may be converted to the unit that a column's name ends with."""

SIZES_M: Mapping[str, tuple[tuple[float, float], ...]] = {
    "Car": ((1.0, 2.8), (1.2, 3.0), (2.0, 9.0)),
    "Van": ((1.3, 4.0), (1.2, 3.5), (2.5, 12.0)),
    "Truck": ((1.5, 6.0), (1.4, 5.0), (3.0, 35.0)),
    "Pedestrian": ((0.6, 2.5), (0.15, 2.0), (0.1, 2.0)),
    "Person_sitting": ((0.5, 2.2), (0.15, 2.0), (0.1, 2.5)),
    "Cyclist": ((0.8, 2.6), (0.2, 1.5), (0.8, 3.0)),
    "Tram": ((2.0, 6.0), (1.5, 5.0), (2.5, 80.0)),
}
"""Height, width and length [m] between which the median of a class lies; KITTI's and nuScenes' do
by far."""
SIZE_COLUMNS = ("height_m", "width_m", "length_m")
FARTHEST_M = 400.0
"""Median distance beyond which no sensor of a road vehicle reports obstacles."""
NEAREST_M = 0.5
"""Median distance below which obstacles would be inside of the vehicle."""
TYPICAL_M = (2.0, 150.0)
"""Where the median distance of real data sets lies."""
LARGEST_ANGLE_RAD = 7.0
"""Above two turns' half; KITTI's own labels keep within one."""
JUDGED_ROWS = 100_000
"""At least so many rows of a larger table, evenly spread, are looked at."""
FEWEST = 8
"""Rows of a class, or of a table, whose median says something."""


def unit_factor(unit: Unit, column: str, *, where: str) -> float:
    """What a value is multiplied by to be in the unit that a column's name ends with.

    Raises:
        ConfigError: The column is in none, or in one that the unit cannot be converted to.
    """
    known = next((units for end, units in ENDINGS.items() if column.endswith(end)), {})
    known = IN_SHARES if column == "truncation" else known
    if unit not in known:
        allowed = f"one of {', '.join(known)}" if known else "left out, as it has no unit"
        message = f"{where}.unit: {unit!r} for {column} must be {allowed}"
        raise ConfigError(message)
    return known[unit]


def check_plausible(salient: FloatArray) -> None:
    """Whether salient variables ``[n, 11]`` can be in metres, radians and shares.

    Raises:
        PemError: They cannot, and one line names column, value and what it would be; begins with
            the column.
    """
    some = salient[:: max(1, len(salient) // JUDGED_ROWS)]
    for complaint in (*_sizes(some), *_distances(some), *_angles(some), *_shares(some)):
        raise PemError(complaint)


def _sizes(salient: FloatArray) -> Iterator[str]:
    for class_id, name in enumerate(CLASS_NAMES):
        rows = salient[salient[:, COLUMN["class_id"]] == class_id]
        if len(rows) < FEWEST:
            continue
        medians = [float(np.median(rows[:, COLUMN[column]])) for column in SIZE_COLUMNS]
        for column, value, (low, high) in zip(SIZE_COLUMNS, medians, SIZES_M[name], strict=True):
            if low <= value <= high or value <= 0.0:
                continue
            ranges = zip(medians, SIZES_M[name], strict=True)
            unit = _unit_of(list(ranges)) or _unit_of([(value, (low, high))])
            if unit:
                yield (
                    f"{column} of class {name} is {value:.4g} in the middle, but lies from {low:g} "
                    f"to {high:g} m; {_would_be(value, unit)}"
                )


def _unit_of(values: list[tuple[float, tuple[float, float]]]) -> str:
    """A unit in which all values that are not in their range would be; empty if none."""
    off = [(value, ends) for value, ends in values if not ends[0] <= value <= ends[1]]
    for unit in ("cm", "mm", "ft", "in"):
        factor = IN_METRES[unit]
        if all(low <= factor * value <= high for value, (low, high) in off):
            return unit
    return ""


def _would_be(value: float, unit: str) -> str:
    factor = {**IN_METRES, **IN_RADIANS, **IN_SHARES}[unit]
    kind = " m" if unit in IN_METRES else " rad" if unit in IN_RADIANS else ""
    return (
        f'in {WORDS[unit]} it would be {factor * value:.3g}{kind}: say unit = "{unit}" in the '
        "mapping of a log, or convert it (what are no road users: pem fit --features)"
    )


def _distances(salient: FloatArray) -> Iterator[str]:
    if len(salient) < FEWEST:
        return
    apart = np.hypot(salient[:, COLUMN["x_m"]], salient[:, COLUMN["z_m"]])
    middle = float(np.median(apart))
    if NEAREST_M <= middle <= FARTHEST_M or middle == 0.0:
        return
    low, high = TYPICAL_M
    units = ("cm", "mm") if middle > FARTHEST_M else ("km",)
    unit = next((one for one in units if low <= IN_METRES[one] * middle <= high), "")
    would = _would_be(middle, unit) if unit else "give metres"
    yield (
        f"x_m, z_m: the distance is {middle:.4g} in the middle, but lies from {NEAREST_M:g} to "
        f"{FARTHEST_M:g} m; {would}"
    )


def _angles(salient: FloatArray) -> Iterator[str]:
    for column in ("rotation_y_rad", "alpha_rad"):
        large = np.abs(salient[:, COLUMN[column]])
        beyond = large > LARGEST_ANGLE_RAD
        if np.count_nonzero(beyond) > max(1, len(large) // 20):
            value = float(np.median(large[beyond]))
            yield f"{column} is {value:.4g}, but lies within 2 pi; {_would_be(value, 'deg')}"


def _shares(salient: FloatArray) -> Iterator[str]:
    share = salient[:, COLUMN["truncation"]]
    if len(share) and float(share.max()) > 1.0:
        value = float(share.max())
        yield f"truncation is {value:.4g}, but lies from 0 to 1; {_would_be(value, '%')}"
