"""What each kind of diagnostic means, and the limits of what weights tell."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from pemviz.sampling.description import IntervalBasis
from pemviz.types import DiagnosticKind

RELIABLE_PARETO_K = 0.7
"""Above it an average of weights is not to be trusted (Vehtari et al. 2024)."""
LARGE_SHARE = 0.2
SMALL_ESS = 10.0


@dataclass(frozen=True)
class Meaning:
    """What a kind of diagnostic means.

    Attributes:
        phrase: In every text of this kind and in none of another.
        undermines: The intervals that it makes unreliable.
        in_repetitions: What is told of how many repetitions; ``None`` where it does not concern
            their mean.
        reason: Why nothing may be decided by the estimate, with its ``value``; ``None``: the text.
        worst: The least favourable of several values.
    """

    phrase: str
    undermines: frozenset[IntervalBasis]
    in_repetitions: str | None = None
    reason: str | None = None
    worst: Callable[[Iterable[float]], float] = max


NOTHING: frozenset[IntervalBasis] = frozenset()
ALL: frozenset[IntervalBasis] = frozenset(("counts", "weights", "runs"))
# a count's interval is exact, however few were counted
ALL_BUT_COUNTS = ALL - {"counts"}

MEANINGS: Mapping[DiagnosticKind, Meaning] = {
    "no-failure": Meaning(
        phrase="no failure",
        undermines=ALL_BUT_COUNTS,
        in_repetitions="no failure was seen",
        worst=min,
    ),
    "few-failures": Meaning(
        phrase="failures were seen: the interval is wide", undermines=NOTHING, worst=min
    ),
    "large-weight": Meaning(
        phrase="one rollout carries",
        undermines=ALL_BUT_COUNTS,
        in_repetitions=f"one rollout carries over {LARGE_SHARE:.0%} of the weight",
        reason="one rollout carries {:.0%} of the weight",
    ),
    "few-effective-samples": Meaning(
        phrase="a few weights carry the estimate",
        undermines=ALL_BUT_COUNTS,
        in_repetitions=(
            f"a few weights carry the estimate (effective sample size below {SMALL_ESS:g})"
        ),
        reason="the effective sample size is {:.1f}",
        worst=min,
    ),
    "heavy-tail": Meaning(
        phrase="the weights' tail is too heavy",
        undermines=ALL_BUT_COUNTS,
        in_repetitions=f"the weights' tail is too heavy (Pareto k-hat above {RELIABLE_PARETO_K})",
        reason="Pareto k-hat is {:.2f}",
    ),
    "died-out": Meaning(
        phrase="no particle reached a violation",
        undermines=ALL,
        in_repetitions="there was a run in which no particle reached a violation",
    ),
    "not-absorbing": Meaning(
        phrase="nothing tells during a rollout whether it has violated",
        undermines=ALL,
        in_repetitions="nothing tells during a rollout whether it has violated",
    ),
    "few-runs": Meaning(
        phrase="of splitting are too few",
        undermines=ALL,
        in_repetitions="there were too few runs for an interval",
        worst=min,
    ),
    "runs-differ": Meaning(
        phrase="the runs differ too much",
        undermines=ALL,
        in_repetitions="the runs differed too much for an interval",
    ),
    "few-ancestors": Meaning(
        phrase="have a common ancestor",
        undermines=ALL,
        in_repetitions="violating particles descended from very few ancestors",
    ),
    "wide-interval": Meaning(
        phrase="it tells only the order of magnitude",
        undermines=NOTHING,
        in_repetitions="the answer gave only the order of magnitude",
    ),
    # the logarithm is as good as any
    "below-doubles": Meaning(
        phrase="too small for a floating-point number", undermines=NOTHING, worst=min
    ),
    "called-safe": Meaning(
        phrase="value function calls safe",
        undermines=ALL,
        in_repetitions="states that the value function calls safe may carry more than its error",
    ),
    "parts-disagree": Meaning(
        phrase="parts of the rollouts disagree",
        undermines=ALL_BUT_COUNTS,
        in_repetitions="parts of the rollouts disagree",
        reason="parts of the rollouts are {:.1f} standard errors apart",
    ),
    "exploration-alone": Meaning(
        phrase="no proposal but the exploration proposals",
        undermines=ALL_BUT_COUNTS,
        in_repetitions="a failure mode was met by hardly any proposal but exploration",
    ),
    "reference-disagrees": Meaning(phrase="times the reference", undermines=ALL),
    # the estimate may be right all the same
    "reference-unreliable": Meaning(phrase="the reference itself is", undermines=NOTHING),
    # of a file that an older version wrote: what is not known may be serious
    "unclassified": Meaning(phrase="", undermines=ALL),
}
