"""What a problem is, in numpy and scipy alone: it begins, and moves given what is random.

Others' programs, in an environment without pemviz, are given the same definitions as pemviz.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

Numbers = NDArray[np.float64]
Flags = NDArray[np.bool_]
Values = Mapping[str, NDArray[Any]]
LimitFunction = Callable[[Numbers], Numbers]
"""Standard normals ``[N, D]`` to g, ``[N]``: below 0 it fails."""

SURE = 40.0
"""Logit of a detector that has no say."""


class Motion(Protocol):
    """A problem: a state of named values ``[N]`` that begins and moves.

    It fails where :meth:`margin` is below 0 in one of its ``steps + 1`` states.
    """

    @property
    def starts(self) -> int:
        """Standard normals at the start."""
        ...

    @property
    def noises(self) -> int:
        """Standard normals at each step."""
        ...

    @property
    def misses(self) -> bool:
        """Whether a detector has a say."""
        ...

    @property
    def steps(self) -> int:
        """How many times it moves."""
        ...

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """The values that can be measured, and about where they lie; the others are hidden."""
        ...

    @property
    def spec(self) -> str:
        """That it does not fail, in signal temporal logic over the values shown."""
        ...

    def begin(self, start: Numbers) -> Values:
        """The first state, given standard normals ``[N, starts]``."""
        ...

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:
        """The next state, given outcomes ``[N]`` and standard normals ``[N, noises]``."""
        ...

    def logit(self, values: Values) -> Numbers:
        """Logit of 'detected' ``[N]``, from values shown alone."""
        ...

    def margin(self, values: Values) -> Numbers:
        """How far from failing, ``[N]``."""
        ...


@dataclass(frozen=True, kw_only=True)
class LimitState:
    """A static problem: a function of standard normals, below 0 where it fails.

    Attributes:
        function: Standard normals ``[N, D]`` to g ``[N]``.
        starts: D.
    """

    function: LimitFunction
    starts: int
    noises: int = 0
    misses: bool = False
    steps: int = 1
    spec: str = "always[0,1] (g >= 0.0)"

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """The function's value alone."""
        return {"g": (-100.0, 100.0)}

    def begin(self, start: Numbers) -> Values:
        """The function's value."""
        return {"g": self.function(start)}

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """Nothing moves."""
        return values

    def logit(self, values: Values) -> Numbers:
        """Detected, to no effect."""
        return np.full(np.shape(values["g"]), SURE)

    def margin(self, values: Values) -> Numbers:
        """The function's value."""
        return values["g"]


def dimension(motion: Motion) -> int:
    """How many standard normals decide a rollout, those that outcomes come of included."""
    return motion.starts + motion.steps * (motion.noises + motion.misses)


def limit_function(motion: Motion) -> LimitFunction:
    """The least margin of a rollout as a function of its standard normals ``[N, D]``.

    First those of the start, then, step by step, those of the noise and one that decides whether
    perception detects: it does where Phi(z) is at least the probability of a miss.
    """

    def least_margin(normals: Numbers) -> Numbers:
        values = motion.begin(normals[:, : motion.starts])
        least = np.array(motion.margin(values), dtype=np.float64)
        each, sure = motion.noises + motion.misses, np.ones(len(normals), dtype=np.bool_)
        for step in range(motion.steps):
            first = motion.starts + step * each
            noise = normals[:, first : first + motion.noises]
            detected = sure
            if motion.misses:
                log_miss = -np.logaddexp(0.0, motion.logit(values))
                detected = log_ndtr(normals[:, first + motion.noises]) >= log_miss
            values = motion.move(values, step, detected, noise)
            least = np.minimum(least, motion.margin(values))
        return least

    return least_margin
