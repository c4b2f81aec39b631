"""Bodies of cars: sizes, the rear as a grid of materials, the outline from the side."""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray, IntArray

NOTHING, PAINT, GLASS, LAMP, DARK, PLATE, TYRE = range(7)
"""Materials."""
GRID = 20
"""Cells of a rear from side to side and from the road to the roof."""


@dataclass(frozen=True)
class Body:
    """A kind of car.

    Attributes:
        name: In pages.
        size_m: Height, width, length [m].
        belt: Where the windows begin, as a share of the height.
        roof: How much narrower the roof is than the rear on either side, as a share of the width.
        cabin: Between which shares of the length, from the rear on, the roof is.
        slope: Over which share of the length the rear and the front window slope.
        lamps: Between which shares of the height the rear lamps are.
    """

    name: str
    size_m: tuple[float, float, float]
    belt: float
    roof: float
    cabin: tuple[float, float]
    slope: tuple[float, float]
    lamps: tuple[float, float]


BODIES = (
    Body("hatchback", (1.46, 1.74, 4.0), 0.60, 0.10, (0.08, 0.62), (0.07, 0.16), (0.50, 0.68)),
    Body("saloon", (1.44, 1.80, 4.6), 0.62, 0.13, (0.24, 0.60), (0.14, 0.16), (0.48, 0.60)),
    Body("estate", (1.47, 1.81, 4.7), 0.60, 0.10, (0.06, 0.62), (0.05, 0.15), (0.48, 0.66)),
    Body("SUV", (1.66, 1.88, 4.5), 0.60, 0.08, (0.06, 0.66), (0.06, 0.13), (0.46, 0.62)),
    Body("minivan", (1.80, 1.84, 4.5), 0.56, 0.06, (0.03, 0.78), (0.03, 0.14), (0.40, 0.66)),
)
SIZES_M: FloatArray = np.array([body.size_m for body in BODIES])
"""Height, width, length by body [m]."""


def rear(body: Body) -> IntArray:
    """Materials of a body's rear ``[GRID, GRID]``, the top row first."""
    cells = np.full((GRID, GRID), NOTHING, dtype=np.int64)
    up = 1.0 - (np.arange(GRID)[:, None] + 0.5) / GRID
    across = (np.arange(GRID)[None, :] + 0.5) / GRID
    aside = np.minimum(across, 1.0 - across)
    above = ((up - body.belt) / (1.0 - body.belt)).clip(0.0, 1.0)
    inside = aside >= body.roof * above
    cells[(up > 0.14) & inside] = PAINT
    low, high = 0.30, 0.12
    cells[(up > high) & (up <= low) & inside] = DARK
    window = (up > body.belt) & (up < 0.94) & (aside > 0.07 + body.roof * above)
    cells[window] = GLASS
    cells[(up > body.lamps[0]) & (up < body.lamps[1]) & (aside < 0.15)] = LAMP
    cells[(up > 0.34) & (up < 0.44) & (aside > 0.36)] = PLATE
    cells[(up <= 0.22) & (aside > 0.04) & (aside < 0.18)] = TYRE
    return cells


REARS: IntArray = np.stack([rear(body) for body in BODIES])
"""Materials by body ``[B, GRID, GRID]``."""
OUTLINES: FloatArray = np.array(
    [(body.belt, *body.cabin, *body.slope) for body in BODIES], dtype=np.float64
)
"""Belt, cabin and slopes by body ``[B, 5]``."""
