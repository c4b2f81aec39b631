"""From the eleven salient columns to the numbers that a network sees.

The paper's 14 inputs: seven classes one-hot, three occlusion levels one-hot, and x, y, z and
rotation_y, each less its training mean and divided by its training standard deviation.
"""

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN, OCCLUSION_NAMES, SALIENT_COLUMNS

POSE_COLUMNS = ("x_m", "y_m", "z_m", "rotation_y_rad")
PAPER_INPUTS = (
    *(f"class={name}" for name in CLASS_NAMES),
    *(f"occlusion={name}" for name in OCCLUSION_NAMES),
    *POSE_COLUMNS,
)
POSE_INDEX = tuple(COLUMN[name] for name in POSE_COLUMNS)

_POSE = slice(POSE_INDEX[0], POSE_INDEX[-1] + 1)
_KIND, _OCCLUSION = COLUMN["class_id"], COLUMN["occlusion"]
_CODED = slice(_KIND, _OCCLUSION + 1, _OCCLUSION - _KIND)  # these two
_FIRST_POSE = len(CLASS_NAMES) + len(OCCLUSION_NAMES)


def check_rows(rows: FloatArray) -> None:
    """Refuse salient variables [n, 11] that no model here was made for.

    Raises:
        PemError: a value is not finite, or a class or occlusion level is unknown.
    """
    if not np.isfinite(rows).all():
        row, column = np.argwhere(~np.isfinite(rows))[0]
        raise PemError(f"salient row {row}: {SALIENT_COLUMNS[column]} is {rows[row, column]}")
    if _are_alike(rows):
        return
    for name, allowed in (("class_id", CLASS_NAMES), ("occlusion", OCCLUSION_NAMES)):
        values = rows[:, COLUMN[name]]
        wrong = (values < 0) | (values >= len(allowed)) | (values != np.floor(values))
        if wrong.any():
            row = int(np.argmax(wrong))
            labels = ", ".join(f"{index} {label}" for index, label in enumerate(allowed))
            raise PemError(f"salient row {row}: {name} is {values[row]:g}, allowed: {labels}")


def _are_alike(rows: FloatArray) -> bool:
    """Whether rows ``[n, 11]`` are of one known class and occlusion, as in most scenarios."""
    if not len(rows):
        return True
    coded = rows[:, _CODED]
    kind, occlusion = coded[0].tolist()
    known = kind in range(len(CLASS_NAMES)) and occlusion in range(len(OCCLUSION_NAMES))
    return known and bool((coded == coded[0]).all())


def paper_inputs(
    rows: FloatArray, *, pose_mean: FloatArray, pose_std: FloatArray, multiple: int = 1
) -> FloatArray:
    """The paper's inputs [14, n] of salient variables [n, 11]; features come first.

    Args:
        rows: salient variables, checked by check_rows, shape [n, 11].
        pose_mean: means of x, y, z [m] and rotation_y [rad] over the training data, shape [4].
        pose_std: their standard deviations, shape [4].
        multiple: columns of zeros follow, to a multiple of so many.
    """
    columns, count = rows.T, len(rows)
    shape = len(PAPER_INPUTS), count + -count % multiple
    inputs = np.empty(shape, dtype=rows.dtype)
    inputs[:, count:] = 0.0
    codes = np.arange(len(CLASS_NAMES), dtype=rows.dtype)[:, None]
    inputs[: len(CLASS_NAMES), :count] = columns[COLUMN["class_id"]] == codes
    inputs[len(CLASS_NAMES) : _FIRST_POSE, :count] = (
        columns[COLUMN["occlusion"]] == codes[: len(OCCLUSION_NAMES)]
    )
    inputs[_FIRST_POSE:, :count] = (columns[_POSE] - pose_mean[:, None]) / pose_std[:, None]
    return inputs


def pose_statistics(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and (sample) standard deviation of x, y, z and rotation_y over rows [n, 11].

    A column that does not vary gets standard deviation 1, so that it maps to 0.
    """
    pose = rows[:, _POSE]
    std = pose.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(len(POSE_COLUMNS))
    return pose.mean(axis=0), np.where(std > 0.0, std, 1.0)
