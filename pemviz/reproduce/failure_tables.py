"""Tables II and III: failure probabilities of methods and of metrics, beside the paper's."""

from collections.abc import Mapping, Sequence

from pemviz.reproduce.differences import table_2_remarks, table_3_remarks
from pemviz.reproduce.experiments import RepetitionOutcome
from pemviz.reproduce.published import NOT_GIVEN, NOTHING, TABLE_2, TABLE_3, Published
from pemviz.reproduce.summary import RowSummary, summarise
from pemviz.reproduce.tables import Cell, Column, Table
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.types import Estimate

Outcomes = Mapping[str, Sequence[RepetitionOutcome]]

COLUMNS = (
    Column("repetitions", ""),
    Column("rollouts_in_estimate", ""),
    Column("violating_share", "violating, ours", ".1%"),
    Column("violating_share_std_error", "+-", ".1%"),
    Column("violating_share_paper", "violating, paper", ".0%", NOT_GIVEN),
    Column("probability", "probability, ours"),
    Column("std_error", "+-", ".2g"),
    Column("median_probability", "median"),
    Column("probability_paper", "probability, paper", ".2g", NOT_GIVEN),
    Column("std_error_paper_as_printed", "+- as printed", ".2g", NOT_GIVEN),
    Column("upper_95_bound", "upper bound", ".2g"),
    Column("upper_95_bound_caveats", "is it a 95 % bound?"),
    Column("reference", "exact", ".3g", "not known"),
    Column("median_over_reference", "median / exact", ".2g"),
    Column("nll_mean_nats", "NLL, mean [nats]", ".3g"),
    Column("nll_log_mean_nats", "NLL of mean likelihood [nats]", ".3g"),
    Column("smallest_ess", "smallest ESS", ".2g"),
    Column("largest_pareto_k", "largest k-hat", ".2g"),
)


def table_2(outcomes: Outcomes, reference: Reference | None) -> Table:
    """Methods by name."""
    rows = {name: summarise([one.estimate for one in ones]) for name, ones in outcomes.items()}
    return Table(
        name="table2",
        title="Table II: methods",
        columns=(Column("method", "method"), *COLUMNS),
        rows=tuple(
            _row(name, row, TABLE_2.get(name, NOTHING), reference) for name, row in rows.items()
        ),
        remarks=tuple(table_2_remarks(rows, reference)),
    )


def table_3(outcomes: Outcomes, reference: Reference | None) -> Table:
    """The paper's algorithm by metric."""
    rows = {name: summarise([one.estimate for one in ones]) for name, ones in outcomes.items()}
    published: Mapping[str, Published] = {str(name): row for name, row in TABLE_3.items()}
    return Table(
        name="table3",
        title="Table III: robustness metrics",
        columns=(Column("metric", "metric"), *COLUMNS),
        rows=tuple(_row(name, row, published[name], reference) for name, row in rows.items()),
        remarks=tuple(table_3_remarks(rows)),
    )


def _row(
    name: str, row: RowSummary, paper: Published, reference: Reference | None
) -> tuple[Cell, ...]:
    exact = None if reference is None else reference.probability
    ratio = None if exact is None or row.median == 0.0 else row.median / exact
    return (
        name,
        row.repetitions,
        row.rollouts_in_estimate,
        row.violating_share,
        row.violating_share_std_error,
        paper.violation_share,
        row.pooled.probability,
        row.pooled.std_error,
        row.median,
        paper.probability,
        paper.std_error,
        row.pooled.ci_high,
        _is_bound(row.pooled),
        exact,
        ratio,
        row.pooled.nll_mean,
        row.pooled.nll_log_mean,
        row.pooled.ess,
        row.pooled.pareto_k,
    )


def _is_bound(pooled: Estimate) -> str | None:
    """Whether the interval's upper end is a bound at its level, and why not."""
    if pooled.ci_high is None:
        return None
    caveats = interval_caveats(pooled)
    return f"no: {'; '.join(caveats)}" if caveats else "yes"
