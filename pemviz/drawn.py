"""What is known of all rollouts of a large stage, of which the least robust alone are held."""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray, read_only


@dataclass(frozen=True)
class Drawn:
    """All N rollouts of a stage that holds M of them; its arrays are read-only.

    Attributes:
        row: Which it holds, ascending, ``[M]``.
        every: Among them is every so many-th, from the first on: an even sample of all.
        robustness: Of all, ``[N]``.
        violated: ``[N]``.
        log_weight: ``[N]`` [nats].
    """

    row: IntArray
    every: int
    robustness: FloatArray
    violated: BoolArray
    log_weight: FloatArray

    def __post_init__(self) -> None:
        """Observers are told of it: they must not change what a run computes."""
        for name in ("row", "robustness", "violated", "log_weight"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return int(self.violated.size)

    @property
    def even(self) -> BoolArray:
        """Which of those held are the even sample, ``[M]``."""
        return self.row % self.every == 0


def place_of(rollout: int, drawn: Drawn | None) -> int:
    """Where a rollout stands among those that its stage holds; ``None``: it holds all."""
    return rollout if drawn is None else int(np.searchsorted(drawn.row, rollout))


def numbers_of(count: int, drawn: Drawn | None) -> IntArray:
    """Index in its stage of each of ``count`` rollouts held, ``[count]``."""
    return np.arange(count, dtype=np.int64) if drawn is None else drawn.row
