"""A made-up table of obstacles, to try fitting and evaluating without KITTI.

``python -m studies.synthetic_obstacles OUT.csv`` writes it. Obstacles are sampled from simple laws
with sizes and places typical of streets; the detector is a formula, `true_logit`, so that what a
model should learn is known. Nothing in it comes from KITTI.
"""

import sys
from pathlib import Path

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.pem.data.table import SalientTable, save_table
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS

OBSTACLES = 3000
SEED = 20220912

_CLASS_SHARES = (0.70, 0.08, 0.03, 0.12, 0.01, 0.04, 0.02)
_SIZES_M = (
    (1.5, 1.6, 3.9),
    (2.2, 1.9, 5.1),
    (3.2, 2.6, 10.0),
    (1.75, 0.65, 0.85),
    (1.3, 0.6, 0.8),
    (1.7, 0.6, 1.8),
    (3.5, 2.5, 15.0),
)
"""Typical height, width, length by class [m]."""


def synthetic_table(*, obstacles: int = OBSTACLES, seed: int = SEED) -> SalientTable:
    """Sample obstacles and outcomes, rounded to two decimals as labels are."""
    random = np.random.default_rng(seed)
    rows = np.empty((obstacles, len(SALIENT_COLUMNS)))
    class_id = random.choice(len(_CLASS_SHARES), obstacles, p=_CLASS_SHARES)
    z_m = np.clip(random.gamma(2.5, 11.0, obstacles), 2.0, 100.0)
    x_m = random.uniform(-0.75, 0.75, obstacles) * z_m
    along_road = random.choice((-np.pi / 2, np.pi / 2), obstacles)
    rotation = along_road + random.normal(0.0, 0.15, obstacles)
    turned = random.random(obstacles) < 0.2
    rotation[turned] = random.uniform(-np.pi, np.pi, int(turned.sum()))
    at_edge = np.abs(x_m) > 0.68 * z_m
    rows[:, COLUMN["class_id"]] = class_id
    rows[:, COLUMN["truncation"]] = np.where(at_edge, random.random(obstacles), 0.0)
    rows[:, COLUMN["occlusion"]] = random.choice(3, obstacles, p=(0.55, 0.27, 0.18))
    sizes = np.asarray(_SIZES_M)[class_id] * np.exp(random.normal(0.0, 0.06, (obstacles, 3)))
    rows[:, COLUMN["height_m"] : COLUMN["length_m"] + 1] = sizes
    rows[:, COLUMN["x_m"]] = x_m
    rows[:, COLUMN["y_m"]] = 1.65 + random.normal(0.0, 0.01, obstacles) * z_m
    rows[:, COLUMN["z_m"]] = z_m
    rows[:, COLUMN["rotation_y_rad"]] = _wrapped(rotation)
    rows[:, COLUMN["alpha_rad"]] = _wrapped(rotation - np.arctan2(x_m, z_m))
    rows = np.round(rows, 2)
    detected = random.random(obstacles) < 1.0 / (1.0 + np.exp(-true_logit(rows)))
    return SalientTable(rows, detected, source="synthetic obstacles (made up, no real data)")


def true_logit(rows: FloatArray) -> FloatArray:
    """The logit of P(detected) from which outcomes are sampled, shape [n], of rows [n, 11]."""
    height, z_m = rows[:, COLUMN["height_m"]], rows[:, COLUMN["z_m"]]
    apparent = np.log(height / np.maximum(z_m, 0.5))
    occlusion, truncation = rows[:, COLUMN["occlusion"]], rows[:, COLUMN["truncation"]]
    is_tram = rows[:, COLUMN["class_id"]] == 6
    return 6.5 + 1.1 * apparent - 1.0 * occlusion - 2.0 * truncation - 0.7 * is_tram


def _wrapped(angle_rad: FloatArray) -> FloatArray:
    return np.angle(np.exp(1j * angle_rad))


def main(arguments: list[str]) -> int:
    """Write the table to the path given; gives the exit code."""
    if len(arguments) != 1:
        print("usage: python -m studies.synthetic_obstacles OUT.csv", file=sys.stderr)
        return 2
    save_table(synthetic_table(), Path(arguments[0]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
