"""Ratios of predictions and the truth, with intervals, and their words."""

import math

from studies.detector_in_the_loop.predictions import VISIBILITY, Answer
from studies.detector_in_the_loop.study import HIDDEN, Truth
from studies.logical_scenarios.answers import Answer as Known
from studies.logical_scenarios.answers import Factor, factor, short

VARIANT_TITLES = {
    "independent": "independent",
    "memory": "memory",
    "frailty": "frailty",
    "both": "both",
    VISIBILITY: "visibility that comes and goes",
    HIDDEN: "both, light and weather known",
}
WITHIN = 2.0

__all__ = ["VARIANT_TITLES", "holds", "ratio_of", "ratio_words", "short"]


def ratio_of(answer: Answer, truth: Truth) -> Factor:
    """A prediction over the truth; without an interval of its own it counts as exact."""
    if answer.probability == 0.0 or truth.probability == 0.0:
        value = math.inf if truth.probability == 0.0 else 0.0
        high = (answer.high or 0.0) / truth.low if truth.low else math.inf
        return Factor(value, answer.probability / truth.high, high)
    low = answer.probability if answer.low is None else max(answer.low, 1e-3 * answer.probability)
    high = answer.probability if answer.high is None else answer.high
    true_low = max(truth.low, 1e-3 * truth.probability)
    return factor(
        Known("weighted", answer.probability, low, high),
        Known("counted", truth.probability, true_low, truth.high),
    )


def holds(ratio: Factor) -> bool:
    """Whether a prediction is within a factor :data:`WITHIN` of the truth."""
    return ratio.value is not None and 1.0 / WITHIN <= ratio.value <= WITHIN


def ratio_words(ratio: Factor) -> str:
    """A ratio with its interval; bold where it is within a factor of two."""
    if ratio.value is None or not math.isfinite(ratio.value):
        return f"over {number(ratio.low)}"
    words = f"{number(ratio.value)} ({number(ratio.low)} to {number(ratio.high)})"
    return f"**{words}**" if holds(ratio) else words


def number(value: float) -> str:
    """Two digits."""
    if value == 0.0 or not math.isfinite(value):
        return "0" if value == 0.0 else "infinity"
    if 0.01 <= value < 10.0:
        return f"{value:#.2g}"
    return f"{value:,.0f}" if 10.0 <= value < 1e5 else f"{value:.0e}"
