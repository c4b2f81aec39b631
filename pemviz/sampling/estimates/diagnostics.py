"""What is wrong with an estimate: every diagnostic is made here, with its limit and its words.

But for those of splitting's runs, which stand beside it.
"""

import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from pemviz.sampling.estimates.weight_diagnostics import WeightFigures
from pemviz.types import Diagnostic, DiagnosticKind, Estimate

IntervalBasis = Literal["counts", "weights", "runs"]
"""What an estimate and its interval rest on: a count of failures and the exact binomial, an average
of importance weights and their spread, or a mean of independent runs, whose rollouts carry no
weights, and how far the runs differ."""

RELIABLE_PARETO_K = 0.7
"""Above it an average of however many weights is not to be trusted, if the tail carries what
matters (Vehtari et al. 2024)."""
LIGHT_LOAD = 1.96
"""Standard errors, the half-width of a 95 % interval, within which what a tail carries does not."""
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
        remedy: What to do about it, whatever the method; ``None``: what its method says.
    """

    phrase: str
    undermines: frozenset[IntervalBasis]
    in_repetitions: str | None = None
    reason: str | None = None
    worst: Callable[[Iterable[float]], float] = max
    remedy: str | None = None


NOTHING: frozenset[IntervalBasis] = frozenset()
ALL: frozenset[IntervalBasis] = frozenset(("counts", "weights", "runs"))
# a count's interval is exact, however few were counted
ALL_BUT_COUNTS = ALL - {"counts"}

MEANINGS: Mapping[DiagnosticKind, Meaning] = {
    # a count too: nothing says that what else decided is random as it would be on the road
    "not-repeatable": Meaning(
        phrase="simulated again went otherwise",
        undermines=ALL,
        in_repetitions="rollouts that were simulated again went otherwise",
        reason="{:.0%} of the rollouts that were simulated again went otherwise",
        remedy="make the same outcomes give the same rollout; declare as latents what is random",
    ),
    # counted as violations they can only raise an answer
    "lost-rollouts": Meaning(
        phrase="could not be simulated and count as",
        undermines=NOTHING,
        in_repetitions="there were rollouts that could not be simulated",
    ),
    "lost-matter": Meaning(
        phrase="had they violated",
        undermines=ALL,
        in_repetitions="rollouts that could not be simulated would change the answer",
        remedy="--lost violation, or a simulator that does not break there",
    ),
    "no-failure": Meaning(
        phrase="no failure",
        undermines=ALL_BUT_COUNTS,
        in_repetitions="no failure was seen",
        worst=min,
    ),
    "few-failures": Meaning(phrase="seen: the interval is wide", undermines=NOTHING, worst=min),
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
        in_repetitions="the weights' tail is too heavy (Pareto k-hat)",
        reason="Pareto k-hat is {:.2f}",
    ),
    "died-out": Meaning(
        phrase="no particle reached a violation",
        undermines=ALL,
        in_repetitions="there was a run in which no particle reached a violation",
    ),
    "not-absorbing": Meaning(
        phrase="nothing says during a rollout whether it has violated",
        undermines=ALL,
        in_repetitions="nothing says during a rollout whether it has violated",
    ),
    "few-runs": Meaning(
        phrase="are too few for an interval",
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
        phrase="it gives only the order of magnitude",
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
    "uneven-side": Meaning(
        phrase="that begin on one side",
        undermines=ALL_BUT_COUNTS,
        in_repetitions="the weights of violations that begin on one side have too heavy a tail",
    ),
    "plain-disagrees": Meaning(
        phrase="plain rollouts that violate",
        undermines=ALL_BUT_COUNTS,
        in_repetitions="plain rollouts find another probability",
    ),
    "hardly-sampled": Meaning(
        phrase="chains have found are hardly sampled",
        undermines=ALL_BUT_COUNTS,
        in_repetitions="violations that Markov chains have found were hardly sampled",
    ),
    "chains-disagree": Meaning(
        phrase="independent chains find",
        undermines=ALL_BUT_COUNTS,
        in_repetitions="independent chains find a higher probability",
    ),
    # most answers are right without; one that is not shows nothing
    "not-searched": Meaning(
        phrase="too few rollouts for chains",
        undermines=NOTHING,
        in_repetitions="there were too few rollouts for chains to search for failure modes",
    ),
    "reference-disagrees": Meaning(phrase="times the reference", undermines=ALL),
    # the estimate may be right all the same
    "reference-unreliable": Meaning(phrase="the reference itself is", undermines=NOTHING),
    # of a file that an older version wrote: what is not known may be serious
    "unclassified": Meaning(phrase="", undermines=ALL),
}

LARGEST_RATIO = 1e150
"""Of an error to what it is the error of: its square is a float64."""
FEW_FAILURES = 10
SMALLEST_LOG10 = math.log10(sys.float_info.min)
MORE_ERROR, LEAST_ERROR = 2.0, 0.2
"""How many times larger a standard error must be to matter, and as a share of the estimate."""
WIDE_FACTOR = 2.0
AGREEMENT_ERRORS = 3.0
"""Joint standard errors within which two estimates of the same agree."""


def count_diagnostics(
    *, failures: int, rollouts: int, upper: float, confidence: float
) -> tuple[Diagnostic, ...]:
    """Of plain Monte Carlo, whose upper bound holds even without a failure."""
    if failures == 0:
        text = (
            f"no failure in {rollouts} rollouts: the probability is below {upper:.2g} "
            f"with {confidence:.0%} confidence, and nothing more is known"
        )
        return (Diagnostic("no-failure", 0.0, 1.0, text),)
    if failures < FEW_FAILURES:
        were = "failure was" if failures == 1 else "failures were"
        text = f"only {failures} {were} seen: the interval is wide"
        return (Diagnostic("few-failures", float(failures), float(FEW_FAILURES), text),)
    return ()


def reliable_pareto_k(count: int) -> float:
    """Up to which k-hat an average of so many weights, at least 2, is to be trusted.

    The one for which they are just enough, or the limit of all (Vehtari et al. 2024, equation 13).
    """
    return min(1.0 - 1.0 / math.log10(count), RELIABLE_PARETO_K)


def weight_diagnostics(
    figures: WeightFigures, *, failures: int, rollouts: int, log10_probability: float | None
) -> tuple[Diagnostic, ...]:
    """Of an average of importance weights, most serious first."""
    if failures == 0 or log10_probability is None:
        text = (
            f"no failure in {rollouts} rollouts: importance sampling then says nothing about the "
            "probability, not even an upper bound"
        )
        return (Diagnostic("no-failure", 0.0, 1.0, text),)
    return (*_uneven_weights(figures, failures=failures), *_below_doubles(log10_probability))


def _uneven_weights(figures: WeightFigures, *, failures: int) -> Sequence[Diagnostic]:
    share, ess = figures.max_weight_share, figures.ess
    found: list[Diagnostic] = []
    if share is not None and share > LARGE_SHARE:
        text = f"one rollout carries {share:.0%} of the weight: do not quote this number"
        found.append(Diagnostic("large-weight", share, LARGE_SHARE, text))
    if ess is not None and ess < SMALL_ESS:
        text = (
            f"a few weights carry the estimate: the {failures} failures count as {ess:.1f} "
            f"(effective sample size)"
        )
        found.append(Diagnostic("few-effective-samples", ess, SMALL_ESS, text))
    k_hat = _tail_that_matters(figures)
    if k_hat is not None and k_hat > (limit := reliable_pareto_k(failures)):
        text = (
            f"the weights' tail is too heavy (Pareto k-hat {k_hat:.2f}, reliable up to "
            f"{limit:.2g}): the true value may lie outside the interval"
        )
        found.append(Diagnostic("heavy-tail", k_hat, limit, text))
    return found


def _tail_that_matters(figures: WeightFigures) -> float | None:
    """k-hat; ``None`` where there is none, or the tail carries next to nothing."""
    return figures.pareto_k if (figures.tail_load or 0.0) > LIGHT_LOAD else None


def _below_doubles(log10_probability: float) -> Sequence[Diagnostic]:
    if log10_probability >= SMALLEST_LOG10:
        return ()
    text = (
        f"the probability, 10^{log10_probability:.2f}, is too small for a floating-point number "
        "and shows as 0: read log10_probability"
    )
    return (Diagnostic("below-doubles", log10_probability, SMALLEST_LOG10, text),)


def not_absorbing() -> Diagnostic:
    """Of importance sampling whose rollouts do not know when they have violated."""
    text = (
        "nothing says during a rollout whether it has violated, so proposals are wasted on what "
        "comes after: on an exactly solved example such estimates were too low by 59 % on average "
        "at 20 rollouts a stage, by 30 % at 50, by 10 % at 100 and by 0.6 % at 218; give it a "
        "monitor"
    )
    return Diagnostic("not-absorbing", None, None, text)


def called_safe(share: float, *, relative_error: float | None) -> Sequence[Diagnostic]:
    """Of an approximate value function, by the share that leads by way of states called safe.

    ``relative_error`` is the estimate's standard error as a share of it; ``None`` without failures.
    """
    limit = relative_error or 0.0
    if share <= limit:
        return ()
    text = (
        f"states that the approximate value function calls safe may carry {share:.1%} of the "
        f"probability, the standard error is {limit:.1%} of it: compare with method mixture"
    )
    return (Diagnostic("called-safe", share, limit, text),)


def parts_disagreement(*, late: float, halves: float) -> Sequence[Diagnostic]:
    """Of an average of weights, parts of which are estimates of the same.

    In joint standard errors between the final batch and what was sampled before it (``late``), and
    between every other rollout and the rest (``halves``).
    """
    errors, which = max(
        (late, "those sampled last and those before"), (halves, "one half and the other")
    )
    if errors <= AGREEMENT_ERRORS:
        return ()
    text = (
        f"parts of the rollouts disagree, {which} by {errors:.1f} joint standard errors: a "
        "failure mode may not be known well"
    )
    return (Diagnostic("parts-disagree", errors, AGREEMENT_ERRORS, text),)


def exploration_alone(share: float) -> Sequence[Diagnostic]:
    """Of an estimate a share of which exploration proposals would sample sooner than all others."""
    if share <= LARGE_SHARE:
        return ()
    text = (
        f"{share:.0%} of the probability is from failures that no proposal but the exploration "
        "proposals would readily draw: a failure mode is not learned"
    )
    return (Diagnostic("exploration-alone", share, LARGE_SHARE, text),)


def uneven_sides(sides: Sequence[WeightFigures]) -> Sequence[Diagnostic]:
    """Of an average of weights, by those of its violations on each side of the median start.

    Weights of all do not show it where another side carries most of them.
    """
    limit = RELIABLE_PARETO_K
    worst = max((_tail_that_matters(side) or 0.0 for side in sides), default=0.0)
    if worst <= limit:
        return ()
    text = (
        f"the weights of violations that begin on one side of the median start have too heavy a "
        f"tail (Pareto k-hat {worst:.2f}, reliable up to {limit:.2g}): more may violate there"
    )
    return (Diagnostic("uneven-side", worst, limit, text),)


def plain_disagreement(
    probability: float, *, low: float, high: float, failures: int, rollouts: int
) -> Sequence[Diagnostic]:
    """Of an estimate beside a count of plain rollouts, with the count's exact interval."""
    if low <= probability <= high:
        return ()
    text = (
        f"{failures} of {rollouts} plain rollouts that violate cannot be reconciled with it: "
        f"they put the probability between {low:.2g} and {high:.2g}"
    )
    return (Diagnostic("plain-disagrees", failures / rollouts, high, text),)


def not_repeatable(*, repeated: int, differing: int, example: str) -> Sequence[Diagnostic]:
    """Of any estimate, by rollouts that were simulated a second time; an ``example`` in words."""
    if differing == 0:
        return ()
    text = f"{differing} of {repeated} rollouts simulated again went otherwise ({example})"
    return (Diagnostic("not-repeatable", differing / repeated, 0.0, text),)


def lost_rollouts(
    *,
    counts_as: Literal["violation", "none"],
    count: int,
    rollouts: int,
    probability: float,
    otherwise: float,
    std_error: float,
) -> Sequence[Diagnostic]:
    """Of any estimate, some of whose ``rollouts`` could not be simulated to their end.

    ``probability`` is that of one of these; if they counted otherwise, the answer would be
    ``otherwise``.
    """
    said = f"{count} of {rollouts} rollouts could not be simulated"
    share = count / rollouts
    if counts_as == "violation":
        text = f"{said} and count as violations; if they did not, these rollouts would say "
        text += f"{otherwise:.2g}"
        return (Diagnostic("lost-rollouts", share, None, text),)
    if probability <= std_error:
        text = f"{said} and count as none; as violations they would make it {otherwise:.2g}"
        return (Diagnostic("lost-rollouts", share, None, text),)
    text = f"{said}: had they violated, the answer would be {otherwise:.2g}"
    return (Diagnostic("lost-matter", probability, std_error, text),)


def hardly_sampled(*, by_chains: float, by_weights: float) -> Sequence[Diagnostic]:
    """Of an average of weights with the relative standard error ``by_weights``.

    ``by_chains`` is the same as violations tell it that were found without its proposals.
    """
    if by_chains <= max(MORE_ERROR * by_weights, LEAST_ERROR):
        return ()
    text = (
        f"violations that Markov chains have found are hardly sampled: by them the standard "
        f"error is {by_chains:.2g} of the estimate, by the weights {by_weights:.2g}"
    )
    return (Diagnostic("hardly-sampled", by_chains, MORE_ERROR * by_weights, text),)


def not_searched() -> Diagnostic:
    """Of an estimate by proposals, where limits left nothing for chains that were to search."""
    text = (
        "the limits left too few rollouts for chains to search for failure modes: what neither "
        "exploration nor plain rollouts met is not in the answer"
    )
    return Diagnostic("not-searched", None, None, text)


def chains_disagreement(*, more: float, allowed: float) -> Sequence[Diagnostic]:
    """Of an estimate beside independent chains that find ``more``, in logarithms [nats].

    ``allowed`` is half of the chains' own 99 % interval. That tells little of less than a factor
    of 2.
    """
    limit = max(allowed, math.log(WIDE_FACTOR))
    if more <= limit:
        return ()
    text = f"independent chains find {math.exp(more):.2g} times the estimate"
    return (Diagnostic("chains-disagree", more, limit, text),)


def reference_disagreement(
    estimate: Estimate, *, probability: float, std_error: float, trusted: bool = True
) -> Sequence[Diagnostic]:
    """Of an estimate beside the reference, with the reference's own standard error.

    They agree if the reference lies in the estimate's interval, or within three of their joint
    standard errors both as they are and as logarithms: a linear scale is blind to an estimate
    that is many times too high, a logarithmic one to one that is as many times too low. The
    reference is ``trusted`` if its own diagnostics hold.
    """
    low, high = estimate.ci_low, estimate.ci_high
    if low is not None and high is not None and low <= probability <= high:
        return ()
    error = estimate.std_error or 0.0
    errors = max(
        _ratio(abs(estimate.probability - probability), math.hypot(error, std_error)),
        _errors_apart_in_log(estimate.probability, error, probability, std_error),
    )
    if errors <= AGREEMENT_ERRORS:
        return ()
    text = (
        f"the estimate is {_ratio(estimate.probability, probability):.2g} times the reference "
        f"{probability:.3g} and its interval does not contain it: "
        f"{'trust the reference' if trusted else 'the reference is unreliable too'}"
    )
    value = errors if math.isfinite(errors) else None
    return (Diagnostic("reference-disagrees", value, AGREEMENT_ERRORS, text),)


def unreliable_reference(reasons: Sequence[str]) -> Sequence[Diagnostic]:
    """Of a reference whose own diagnostics do not hold, for ``reasons``; nothing without any."""
    if not reasons:
        return ()
    text = f"the reference itself is unreliable: {'; '.join(reasons)}"
    return (Diagnostic("reference-unreliable", None, None, text),)


def _errors_apart_in_log(one: float, error: float, other: float, other_error: float) -> float:
    """How many joint standard errors two logarithms are apart, of log-normal estimates."""
    if one == other:
        return 0.0
    if not (one and other and one / other):
        return math.inf
    relative = (min(error / one, LARGEST_RATIO), min(other_error / other, LARGEST_RATIO))
    variance = sum(math.log1p(ratio**2) for ratio in relative)
    return _ratio(abs(math.log(one / other)), math.sqrt(variance))


def _ratio(value: float, unit: float) -> float:
    if unit:
        return value / unit
    return math.inf if value else 0.0


def repetition_diagnostics(
    estimates: Sequence[Estimate], *, log10_probability: float | None
) -> tuple[Diagnostic, ...]:
    """Of the mean of repetitions: what is wrong with how many of them.

    Values are the least favourable among the repetitions; ``log10_probability`` is that of their
    mean.
    """
    each = [_of_repetition(estimate) for estimate in estimates]
    found: list[Diagnostic] = []
    for kind, meaning in MEANINGS.items():
        same = [one for diagnostics in each for one in diagnostics if one.kind == kind]
        if same and meaning.in_repetitions is not None:
            values = [one.value for one in same if one.value is not None]
            text = f"in {len(same)} of {len(each)} repetitions {meaning.in_repetitions}"
            worst = meaning.worst(values) if values else None
            found.append(replace(same[0], value=worst, text=text))
    tiny = () if log10_probability is None else _below_doubles(log10_probability)
    return (*found, *tiny)


def _of_repetition(estimate: Estimate) -> Sequence[Diagnostic]:
    """A repetition's diagnostics by its figures, whatever its method; then the method's own."""
    none = Diagnostic("no-failure", 0.0, 1.0, "no failure was seen")
    # what a tail carries is not kept, only whether that was too much: among the method's own
    figures = WeightFigures(estimate.ess, None, estimate.max_weight_share, None)
    by_figures = [
        *([] if estimate.failures else [none]),
        *_uneven_weights(figures, failures=estimate.failures),
    ]
    kinds = {one.kind for one in by_figures}
    return (*by_figures, *(one for one in estimate.diagnostics if one.kind not in kinds))


def classified(texts: Sequence[str], estimate: Estimate) -> tuple[Diagnostic, ...]:
    """The diagnostics of an estimate of which only the warnings' ``texts`` were kept."""
    return tuple(_of_text(text, estimate) for text in texts)


def _of_text(text: str, estimate: Estimate) -> Diagnostic:
    values: Mapping[DiagnosticKind, tuple[float | None, float]] = {
        "no-failure": (0.0, 1.0),
        "few-failures": (float(estimate.failures), float(FEW_FAILURES)),
        "large-weight": (estimate.max_weight_share, LARGE_SHARE),
        "few-effective-samples": (estimate.ess, SMALL_ESS),
        "heavy-tail": (estimate.pareto_k, RELIABLE_PARETO_K),
        "below-doubles": (estimate.log10_probability, SMALLEST_LOG10),
    }
    for kind, meaning in MEANINGS.items():
        if meaning.phrase and meaning.phrase in text:
            value, limit = values.get(kind, (None, None))
            return Diagnostic(kind, value, limit, text)
    return Diagnostic("unclassified", None, None, text)


def undermining(
    diagnostics: Iterable[Diagnostic], *, basis: IntervalBasis
) -> tuple[Diagnostic, ...]:
    """Those that make an interval unreliable."""
    return tuple(one for one in diagnostics if basis in MEANINGS[one.kind].undermines)


def reason(diagnostic: Diagnostic) -> str:
    """Why nothing may be decided by an estimate, in a few words."""
    words = MEANINGS[diagnostic.kind].reason
    if words is None or diagnostic.value is None:
        return diagnostic.text
    return words.format(diagnostic.value)
