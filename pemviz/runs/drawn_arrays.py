"""What is known of all rollouts of a stage that holds some of them, in the stage's file."""

from collections.abc import Mapping

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.types import Drawn

ALL = "all."
"""Before the names of what is known of all rollouts."""
ROLLOUT = "rollout"
"""Each rollout's index in its stage, in files that do not hold all of them."""
EVERY = f"{ALL}every"


def drawn_arrays(drawn: Drawn | None) -> dict[str, AnyArray]:
    """In a stage's file, beside the indices of the rollouts that it holds."""
    if drawn is None:
        return {}
    return {
        EVERY: np.array(drawn.every),
        f"{ALL}robustness": drawn.robustness,
        f"{ALL}violated": drawn.violated,
        f"{ALL}log_weight": drawn.log_weight,
    }


def drawn_of(arrays: Mapping[str, AnyArray]) -> Drawn | None:
    """The same, read back; ``None`` where a file has nothing of it.

    Raises:
        KeyError: Something of it is missing.
        ValueError: Something does not fit the rest, or is of the wrong type.
    """
    if not any(name.startswith(ALL) for name in arrays):
        return None
    robustness, violated = arrays[f"{ALL}robustness"], arrays[f"{ALL}violated"]
    log_weight, row, every = arrays[f"{ALL}log_weight"], arrays[ROLLOUT], arrays[EVERY]
    count = violated.size
    fits = (
        violated.dtype == np.bool_
        and all(values.dtype == np.float64 for values in (robustness, log_weight))
        and all(values.shape == (count,) for values in (robustness, violated, log_weight))
        and not np.isnan(robustness).any()
        and bool(np.isfinite(log_weight).all())
        and all(values.dtype == np.int64 for values in (row, every))
        and every.shape == ()
        and bool(every > 0)
        and row.shape == arrays["violated"].shape
        and bool(np.all(np.diff(row, prepend=-1) > 0))
        and (row.size == 0 or bool(row[-1] < count))
    )
    if not fits:
        message = "what it tells of all rollouts does not fit together"
        raise ValueError(message)
    return Drawn(row, int(every), robustness, violated, log_weight)
