"""Runs beside the truth: a row for each problem, method and budget, totals, and who is nearer."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from benchmarks.external.record import DONE, Run, as_took

FAR = 1.5
"""Off by more than this factor with nothing said, a run misleads."""
NEAR = 0.1
"""Within this share of the truth a run is right."""
MOST = 1000.0
"""An error counts as at most this factor; so do a zero and a run without an answer."""
OVER = 1.6
"""Others that need more calls than this many times the budget are not compared with."""
BESIDE = (
    "In each cell: error; silent; unwarned intervals that hold the truth. Bold: another's error is "
    "smaller at the same number of calls."
)
NOTES = (
    "Ratio: median of estimate over truth. Error: root mean square of ln(estimate / truth); a "
    f"factor of more than {MOST:g}, a zero and no answer count as a factor of {MOST:g} "
    f"({math.log(MOST):.2f}).",
    "Unwarned: the program itself does not say that the answer is not to be relied on; a zero says "
    "so. Others' programs that give no interval have none to hold.",
    f"Silent: unwarned and off by a factor of more than {FAR:g}. Cries wolf: warned, of the runs "
    f"that are within {NEAR:.0%} of the truth. Calls, CPU time: medians.",
)


@dataclass(frozen=True)
class Row:
    """What the runs of one method at one budget on one problem, or on all, show.

    Attributes:
        problem: Its name, or ``all``.
        method: The method.
        budget: What was asked for.
        runs: How many.
        ratio: Median of estimate over truth, 0 where there is no answer.
        error: Root mean square error of the logarithm [nats].
        unwarned: How many runs do not warn.
        intervals: How many of those give an interval.
        hold: How many of these hold the truth.
        silent: How many runs are unwarned and far off.
        right: How many are within a tenth of the truth.
        wolf: How many of these warn.
        calls: Median of rollouts or evaluations.
        seconds: Median CPU time [s].
    """

    problem: str
    method: str
    budget: str
    runs: int
    ratio: float
    error: float
    unwarned: int
    intervals: int
    hold: int
    silent: int
    right: int
    wolf: int
    calls: float
    seconds: float


@dataclass(frozen=True)
class Nearer:
    """Whose error is smaller on a problem at about the same number of calls.

    Attributes:
        problem: The problem.
        method: The method of pemviz.
        budget: Its budget.
        error: Its error [nats].
        other: The best of the others' methods there.
        other_budget: Its budget, the nearest of those there are.
        other_error: Its error [nats].
    """

    problem: str
    method: str
    budget: str
    error: float
    other: str
    other_budget: str
    other_error: float

    @property
    def ours(self) -> bool:
        """Whether that of pemviz is no larger."""
        return self.error <= self.other_error


def rows_of(runs: Iterable[Run], truths: Mapping[str, float]) -> Sequence[Row]:
    """A row for each problem, method and budget, in the order of the problems."""
    groups = _grouped(runs, lambda run: (run.problem, run.method, run.budget))
    order = {name: place for place, name in enumerate(truths)}
    return [
        _row(name, method, budget, some, truths)
        for (name, method, budget), some in sorted(
            groups.items(), key=lambda item: (order[item[0][0]], *item[0][1:])
        )
    ]


def totals_of(runs: Iterable[Run], truths: Mapping[str, float]) -> Sequence[Row]:
    """A row for each method and budget over all of its problems."""
    groups = _grouped(runs, lambda run: (run.method, run.budget))
    return [
        _row("all", method, budget, some, truths)
        for (method, budget), some in sorted(groups.items())
    ]


def _grouped(runs: Iterable[Run], by: Callable[[Run], Any]) -> dict[Any, list[Run]]:
    groups: dict[Any, list[Run]] = {}
    for run in runs:
        groups.setdefault(by(run), []).append(run)
    return groups


def _row(
    name: str, method: str, budget: str, runs: Sequence[Run], truths: Mapping[str, float]
) -> Row:
    ratios = [(run.estimate or 0.0) / truths[run.problem] for run in runs]
    unwarned = [not run.warned and bool(run.estimate) for run in runs]
    near = [abs(ratio - 1.0) <= NEAR for ratio in ratios]
    holds = [
        run.low <= truths[run.problem] <= run.high
        for run, quiet in zip(runs, unwarned, strict=True)
        if quiet and run.low is not None and run.high is not None
    ]
    far = [not 1.0 / FAR <= ratio <= FAR for ratio in ratios]
    return Row(
        problem=name,
        method=method,
        budget=budget,
        runs=len(runs),
        ratio=median(ratios),
        error=math.sqrt(sum(_log_error(ratio) ** 2 for ratio in ratios) / len(ratios)),
        unwarned=sum(unwarned),
        intervals=len(holds),
        hold=sum(holds),
        silent=sum(quiet and off for quiet, off in zip(unwarned, far, strict=True)),
        right=sum(near),
        wolf=sum(good and not quiet for good, quiet in zip(near, unwarned, strict=True)),
        calls=median(run.calls for run in runs),
        seconds=median(run.seconds for run in runs),
    )


def _log_error(ratio: float) -> float:
    """At most that of the largest factor, whichever way."""
    if not 0.0 < ratio < math.inf:
        return math.log(MOST)
    return max(-math.log(MOST), min(math.log(ratio), math.log(MOST)))


def nearer(ours: Sequence[Row], others: Sequence[Row]) -> Sequence[Nearer]:
    """For each row of ours the best of others' at the budget whose calls are nearest to its."""
    found: list[Nearer] = []
    for row in ours:
        there = beside(row, others)
        if not there:
            continue
        best = min(there, key=lambda other: other.error)
        found.append(
            Nearer(
                problem=row.problem,
                method=row.method,
                budget=row.budget,
                error=row.error,
                other=best.method,
                other_budget=best.budget,
                other_error=best.error,
            )
        )
    return found


def beside(row: Row, others: Sequence[Row]) -> Sequence[Row]:
    """Others' rows on the same problem at one budget: what ``row`` took, or the nearest to it."""
    same = as_took(row.method) if row.budget == DONE else ""
    calls = {
        other.budget: row.calls if other.budget == same else float(other.budget)
        for other in others
        if other.problem == row.problem and (other.budget == same or other.budget.isdecimal())
    }
    there = [
        other
        for other in others
        if other.problem == row.problem
        and other.budget in calls
        and other.calls <= OVER * calls[other.budget]
    ]
    budgets = {other.budget for other in there}
    if not budgets:
        return []
    closest = min(
        budgets,
        key=lambda budget: (budget != same, abs(math.log(calls[budget] / max(row.calls, 1.0)))),
    )
    return [other for other in there if other.budget == closest]


HEADER = (
    "problem", "truth", "method", "budget", "runs", "ratio", "error", "unwarned hold", "silent",
    "cries wolf", "calls", "CPU s",
)  # fmt: skip


def table_lines(
    rows: Sequence[Row],
    totals: Sequence[Row],
    found: Sequence[Nearer],
    truths: Mapping[str, float],
    own: Sequence[str],
) -> Sequence[str]:
    """All of it as Markdown; ``own`` are the methods of pemviz."""
    return [
        *_markdown(HEADER, [_cells(row, truths) for row in (*rows, *totals)]),
        "",
        *_beside_lines(rows, own),
        *_nearer_lines(found),
        *NOTES,
    ]


def _beside_lines(rows: Sequence[Row], own: Sequence[str]) -> Sequence[str]:
    """Problem by problem ours and each of the others' methods, at the same number of calls."""
    others = [row for row in rows if row.method not in own]
    there = [(row, beside(row, others)) for row in rows if row.method in own]
    names = list(dict.fromkeys(other.method for _, some in there for other in some))
    if not names:
        return []
    header = ("problem", "calls", "method", "its error", *names)
    cells = [
        (
            row.problem,
            f"{row.calls:,.0f}",
            f"{row.method}, {row.budget}",
            _shown(row),
            *(_beside_cell(row, some, name) for name in names),
        )
        for row, some in there
        if some
    ]
    return [*_markdown(header, cells), "", BESIDE, ""]


def _beside_cell(row: Row, others: Sequence[Row], name: str) -> str:
    found = [other for other in others if other.method == name]
    if not found:
        return "-"
    (other,) = found
    return f"**{_shown(other)}**" if other.error < row.error else _shown(other)


def _shown(row: Row) -> str:
    holds = f"{row.hold} of {row.intervals}" if row.intervals else "-"
    return f"{row.error:.3f}; {row.silent} of {row.runs}; {holds}"


def _markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> Sequence[str]:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return [*lines, *("| " + " | ".join(cells) + " |" for cells in rows)]


def _cells(row: Row, truths: Mapping[str, float]) -> Sequence[str]:
    return (
        row.problem,
        f"{truths[row.problem]:.4g}" if row.problem in truths else "",
        row.method,
        row.budget,
        f"{row.runs}",
        f"{row.ratio:.3g}",
        f"{row.error:.3f}",
        f"{row.hold} of {row.intervals}" if row.intervals else "-",
        f"{row.silent}",
        f"{row.wolf} of {row.right}",
        f"{row.calls:,.0f}",
        f"{row.seconds:.1f}",
    )


def _nearer_lines(found: Sequence[Nearer]) -> Sequence[str]:
    if not found:
        return []
    header = ("problem", "method", "budget", "error", "best of the others", "error", "nearer")
    cells = [
        (
            one.problem,
            one.method,
            one.budget,
            f"{one.error:.3f}",
            f"{one.other}, {one.other_budget} calls",
            f"{one.other_error:.3f}",
            "pemviz" if one.ours else "**other**",
        )
        for one in found
    ]
    counts = _grouped_counts(found)
    return [*_markdown(header, cells), "", *counts, ""]


def _grouped_counts(found: Sequence[Nearer]) -> Sequence[str]:
    keys = dict.fromkeys((one.method, one.budget) for one in found)
    lines: list[str] = []
    for method, budget in keys:
        some = [one for one in found if (one.method, one.budget) == (method, budget)]
        ours = sum(one.ours for one in some)
        lines.append(f"{method}, {budget}: no worse than the best other on {ours} of {len(some)}.")
    return lines


def document(
    rows: Sequence[Row], totals: Sequence[Row], found: Sequence[Nearer], truths: Mapping[str, float]
) -> Mapping[str, Any]:
    """All of it as JSON."""
    return {
        "schema": 1,
        "truths": dict(truths),
        "rows": [asdict(row) for row in rows],
        "totals": [asdict(row) for row in totals],
        "nearer": [{**asdict(one), "ours": one.ours} for one in found],
        "notes": list(NOTES),
    }
