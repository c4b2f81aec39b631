"""Which of two estimates of a rare event counts, what its range is, and what two answers differ by.

Plain Monte Carlo counts where it has seen the event at least :data:`MANY` times: its interval
(Clopper & Pearson 1934) holds whatever the event. Otherwise ``mixture`` does, if none of its
diagnostics speaks against its interval and that meets the plain one. Otherwise what is left is the
plain interval: wide after a few events, after none an upper bound.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pemviz.sampling.estimates.diagnostics import undermining
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

MANY = 10
"""Events from which on a count tells a probability to within a factor of two."""
Basis = Literal["counted", "weighted", "few", "bound"]


@dataclass(frozen=True)
class Answer:
    """A probability with a 95 % interval.

    Attributes:
        basis: ``counted`` in plain rollouts, ``weighted`` by mixture, counted but ``few`` (below
            :data:`MANY`), or nothing but a ``bound``.
        probability: ``None`` with nothing but a bound.
        low: Lower end.
        high: Upper end; with a ``bound`` it is all there is.
    """

    basis: Basis
    probability: float | None
    low: float
    high: float


@dataclass(frozen=True)
class Factor:
    """How many times as likely an event is in one cell as in another.

    Attributes:
        value: ``None`` where one of the two is but a bound.
        low: Lower end of its 95 % interval; 0 where nothing is known.
        high: Upper end; infinite where nothing is known.
    """

    value: float | None
    low: float
    high: float


def answer(*, weighted: Estimate, plain: Estimate) -> Answer:
    """What two estimates of one event say together.

    Args:
        weighted: By ``mixture``.
        plain: By ``monte-carlo``, whose interval is always there.
    """
    low, high = plain.ci_low or 0.0, 1.0 if plain.ci_high is None else plain.ci_high
    if plain.failures >= MANY:
        return Answer("counted", plain.probability, low, high)
    if (
        not why_not(weighted, plain)
        and weighted.ci_low is not None
        and weighted.ci_high is not None
    ):
        return Answer("weighted", weighted.probability, weighted.ci_low, weighted.ci_high)
    if plain.failures:
        return Answer("few", plain.probability, low, high)
    return Answer("bound", None, 0.0, high)


def why_not(weighted: Estimate, plain: Estimate) -> tuple[str, ...]:
    """What speaks against the interval of ``weighted``, each in a word; empty if nothing does."""
    kinds = [one.kind for one in undermining(weighted.diagnostics, basis="weights")]
    if not kinds and interval_caveats(weighted):
        kinds = [interval_caveats(weighted)[0]]
    low, high = weighted.ci_low, weighted.ci_high
    if low is None or high is None:
        return tuple(dict.fromkeys([*kinds, "no-failure"]))
    if high < (plain.ci_low or 0.0) or low > (1.0 if plain.ci_high is None else plain.ci_high):
        kinds.append("plain Monte Carlo differs")
    return tuple(dict.fromkeys(kinds))


def factor(numerator: Answer, denominator: Answer) -> Factor:
    """The ratio of two independent answers.

    The interval is the one that Zou & Donner 2008 put together from the intervals of the two, in
    logarithms: log r -+ sqrt of the sum of the squared distances from the answers to those of
    their ends that make the ratio smaller, or larger. With nothing but bounds it is from the ends.
    """
    above, below = numerator.probability, denominator.probability
    if above is None or below is None:
        low = numerator.low / denominator.high
        return Factor(None, low, numerator.high / denominator.low if denominator.low else math.inf)
    ratio = above / below
    return Factor(
        ratio,
        ratio * math.exp(-_distance((above, numerator.low), (denominator.high, below))),
        ratio * math.exp(_distance((numerator.high, above), (below, denominator.low))),
    )


def _distance(*pairs: tuple[float, float]) -> float:
    """Root of the sum of squared logarithms of the pairs' ratios."""
    return math.hypot(*(math.log(high / low) if low else math.inf for high, low in pairs))


def words(found: Answer) -> str:
    """An answer with its interval."""
    if found.probability is None:
        return f"below {short(found.high)}"
    return range_words(found.probability, found.low, found.high)


def range_words(probability: float, low: float | None, high: float | None) -> str:
    """A probability with the ends of an interval, if there are any."""
    ends = "" if low is None or high is None else f" ({short(low)} to {short(high)})"
    return f"{short(probability)}{ends}"


def factor_words(found: Factor) -> str:
    """A factor with its interval; with bounds alone, what is certain."""
    if found.value is not None:
        return f"{_plain(found.value)} ({_plain(found.low)} to {_plain(found.high)})"
    if found.low > 1.0:
        return f"over {_plain(found.low)}"
    return f"below {_plain(found.high)}" if found.high < 1.0 else "not known"


def short(probability: float) -> str:
    """A probability in two digits."""
    if probability >= 0.01:
        return f"{probability:#.2g}"
    digits, _, exponent = f"{probability:.1e}".partition("e")
    return "0" if probability == 0.0 else f"{digits}e{int(exponent)}"


def reasons(kinds: Sequence[str]) -> str:
    """What speaks against mixture's interval, for a table."""
    return ", ".join(kinds) or "nothing"


def _plain(value: float) -> str:
    """A factor in two digits, whole from ten on."""
    return f"{value:,.0f}" if value >= 10.0 else f"{value:#.2g}"
