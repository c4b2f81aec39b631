"""Sentences that say where our figures differ from the paper's, and why."""

from collections.abc import Mapping, Sequence

from pemviz.reproduce.published import ADAPTIVE, NAIVE, TABLE_3
from pemviz.reproduce.summary import RowSummary
from pemviz.sampling.zero_variance.reference import Reference

LIMITS = (
    "the paper gives neither the lead car's braking nor the ego's limits, so those of the "
    "scenario are our choice"
)
CLEARLY = 2.0
"""Differences beyond this many standard errors are called differences."""
TABLE_3_SHARE = {str(metric): published.violation_share for metric, published in TABLE_3.items()}


def table_2_remarks(rows: Mapping[str, RowSummary], reference: Reference | None) -> Sequence[str]:
    """About the methods of Table II."""
    remarks: list[str] = []
    for name, row in rows.items():
        if name.startswith("mc_"):
            remarks.append(_monte_carlo(name, row))
        elif name.startswith("naive_"):
            remarks.append(_naive(name, row, reference))
        else:
            remarks += [_adaptive(name, row), _accuracy(name, row, reference)]
    return remarks


def table_3_remarks(rows: Mapping[str, RowSummary]) -> Sequence[str]:
    """About the metrics of Table III."""
    remarks = [
        f"{metric}: {_share_words(row, TABLE_3_SHARE[metric])}" for metric, row in rows.items()
    ]
    remarks.append(
        "The shares depend on how the proposal is trained, which the paper leaves open (its text "
        "and its public code disagree on alpha and epochs; here alpha 0.1 and 500 epochs, as the "
        f"text has it), and on the braking: {LIMITS}."
    )
    remarks.append(
        "Whatever ranks the rollouts, a violation is decided by the formula's Boolean semantics: "
        "the smooth-cumulative score is not sound at 0, so it never counts failures."
    )
    return remarks


def _share_words(row: RowSummary, paper: float | None) -> str:
    ours = f"{row.violating_share:.0%} of the final rollouts violate"
    if paper is None:
        return f"{ours}; the paper's figure is not given here."
    error = row.violating_share_std_error
    if error is None:
        return f"{ours}, in the paper {paper:.0%}; one repetition tells no spread."
    if abs(row.violating_share - paper) <= CLEARLY * error:
        return f"{ours}, in the paper {paper:.0%}: no difference beyond the spread."
    more = "more" if row.violating_share > paper else "fewer"
    return f"{ours}, in the paper {paper:.0%}: {more} here, beyond the spread of repetitions."


def _monte_carlo(name: str, row: RowSummary) -> str:
    rollouts = row.repetitions * row.rollouts_in_estimate
    if row.pooled.failures:
        return f"{name}: {row.pooled.failures} of {rollouts} rollouts violate."
    high = row.pooled.ci_high
    bound = "unknown" if high is None else f"{high:.2g}"
    return (
        f"{name}: none of {rollouts} rollouts violates, as at this probability it must be; all "
        f"that plain simulation says is that the probability is below {bound} (exact 95 % bound)."
    )


def _naive(name: str, row: RowSummary, reference: Reference | None) -> str:
    paper = NAIVE.violation_share or 0.0
    share = row.violating_share
    error = row.violating_share_std_error or 0.0
    verdict = (
        "no difference beyond the spread."
        if abs(share - paper) <= CLEARLY * error
        else f"the scenario differs, since {LIMITS}; with ours, half the detections are hardly "
        "ever enough to stop in time."
        if share > paper
        else f"the scenario differs, since {LIMITS}."
    )
    remark = f"{name}: {share:.1%} of the rollouts violate, in the paper {paper:.0%}: {verdict}"
    if reference is None or row.pooled.probability >= reference.probability / 10.0:
        return remark
    return (
        f"{remark} Its estimate is many orders of magnitude below the exact value: rollouts with "
        "dozens of misses carry no weight under the error model, and the likely violations are "
        "never drawn. Many violations do not make an estimate."
    )


def _adaptive(name: str, row: RowSummary) -> str:
    ours, paper = row.pooled.probability, ADAPTIVE.probability or 0.0
    usual, printed = ADAPTIVE.usual_std_error or 0.0, ADAPTIVE.std_error or 0.0
    spread = (row.pooled.std_error or 0.0) ** 2 + usual**2
    agree = abs(ours - paper) <= CLEARLY * spread**0.5
    verdict = "the two agree within their errors" if agree else "the two differ"
    return (
        f"{name}: {ours:.2g} here, {paper:.2g} +- {printed:.2g} in the paper; {verdict}. The "
        "printed error divides the spread by the number of repetitions; divided by its square "
        f"root, as the error of a mean is (ten repetitions assumed), it is {usual:.1e}. Agreement "
        f"shows a plausible setting and validates nothing: {LIMITS}, and the error model is not "
        f"the authors' unless given with --pem. {_share_words(row, ADAPTIVE.violation_share)}"
    )


def _accuracy(name: str, row: RowSummary, reference: Reference | None) -> str:
    if reference is None:
        return (
            f"{name}: the exact value for this error model is not known here, so how wrong the "
            "estimate is cannot be said."
        )
    ratio = row.median / reference.probability
    verdict = "under-reports" if ratio < 1.0 else "over-reports"
    return (
        f"{name}: the exact value, which the paper could not know, is "
        f"{reference.probability:.3g} +- {reference.std_error:.1g} (by `zero-variance`); half of "
        f"the repetitions give less than {ratio:.2g} of it, so at this budget the algorithm "
        f"typically {verdict}: the mean rests on rare, heavily weighted rollouts that most "
        "repetitions never draw."
    )
