"""What the paper (arXiv 2209.09674) prints, as far as it is known here.

A figure of the paper that is not known here is absent, never guessed: the tables then say
'not given here'.
"""

import math
from dataclasses import dataclass

from pemviz.config import MetricName

NOT_GIVEN = "not given here"
REPETITIONS = 10


@dataclass(frozen=True)
class Published:
    """Figures of one row of the paper; ``None`` where not known here.

    Attributes:
        probability: The failure probability.
        std_error: As printed, which divides by the number of repetitions.
        violation_share: Share of the final rollouts that violate.
    """

    probability: float | None = None
    std_error: float | None = None
    violation_share: float | None = None

    @property
    def usual_std_error(self) -> float | None:
        """The standard error of a mean, which divides by the root of the repetitions.

        The printed one times the square root of ten repetitions.
        """
        return None if self.std_error is None else self.std_error * math.sqrt(REPETITIONS)


NOTHING = Published()
ADAPTIVE = Published(probability=5.0e-15, std_error=3.8e-15, violation_share=0.52)
NAIVE = Published(violation_share=0.77)

TABLE_2 = {
    "mc_100": NOTHING,
    "mc_10000": NOTHING,
    "naive_100": NAIVE,
    "naive_1000": NAIVE,
    "adaptive_100": ADAPTIVE,
}

TABLE_3: dict[MetricName, Published] = {
    "classical": Published(violation_share=0.52),
    "agm": Published(violation_share=0.41),
    "smooth-cumulative": Published(violation_share=0.40),
}

AUTHORS_PEM_DIGEST = "4c478a138947b33dddf048e9b18fbab1550bb3b24e54c9c81b68a54532de968b"
"""Of the authors' published ML-NN network."""
