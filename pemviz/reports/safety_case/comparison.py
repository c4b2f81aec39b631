"""Several runs of a safety case side by side: their answers, settings and claims."""

from collections.abc import Iterator, Sequence

from pemviz.reports.charts import runs_chart
from pemviz.reports.document import Block, Cell, Paragraph, Section, Table, Verdict, figure
from pemviz.reports.estimate_words import interval_text, probability_text
from pemviz.reports.numbers import range_text
from pemviz.reports.safety_case.case import CaseRun
from pemviz.reports.safety_case.claims import GRANTED, Claim, claims
from pemviz.reports.safety_case.sections import MARKS, claim_bound
from pemviz.runs.same_run import setting_differences
from pemviz.runs.trust import run_interval_caveats
from pemviz.runs.uncertainty import uncertainty_budget

MOST_IN_FULL = 8
"""Of more runs the rest stands side by side only."""
MOST_DRAWN = 40
MOST_SETTINGS = 5
COLUMNS = ("", "run", "probability", "interval", "refits", "model classes", "data alone", "trust")


def side_by_side(runs: Sequence[CaseRun], *, below: float | None) -> Iterator[Section]:
    """Every run's answer and uncertainty, how their settings differ, and what each lets claim."""
    caption = "Estimates with their intervals (sampling alone; dashed: no interval at its level)"
    caption += "" if below is None else f"; the dashed line is {below:g}"
    if len(runs) > MOST_DRAWN:
        caption += f"; the first {MOST_DRAWN} of {len(runs)} runs"
    named = [(f"{i}. {run.name}", run.result) for i, run in enumerate(runs[:MOST_DRAWN], start=1)]
    rows = tuple((str(index), *_row(run)) for index, run in enumerate(runs, start=1))
    chart = figure(runs_chart(named, limit=below), caption=f"{caption}.")
    yield Section("answers", "Side by side", (), (*chart, Table(COLUMNS, rows)))
    yield Section("settings", "Settings that differ", (), tuple(_differences(runs)))
    what = "Bounds" if below is None else f"Claims of less than {below:g}"
    yield Section("claims", what, (), (_claims(runs[:MOST_IN_FULL], below=below),))


def _row(run: CaseRun) -> tuple[str, ...]:
    result, estimate = run.result, run.result.estimate
    if estimate is None:
        return (run.name, f"none: the run {result.status}", "", "", "", "", "")
    ends = {
        source.kind: range_text(source.low, source.high) if source.high is not None else "-"
        for source in uncertainty_budget(result)
    }
    against = run_interval_caveats(result)
    return (
        run.name,
        probability_text(estimate),
        interval_text(estimate, caveats=()),
        ends.get("refits", "-"),
        ends.get("model-classes", "-"),
        ends.get("data", "-"),
        f"unreliable: {against[0]}" if against else "no warning",
    )


def _claims(runs: Sequence[CaseRun], *, below: float | None) -> Table:
    """A row for what is granted, a column for each run."""
    found = [{one.kind: one for one in claims(run.result, below=below)} for run in runs]
    models = ", ".join(dict.fromkeys(run.result.pem.name for run in runs))
    rows: list[tuple[Cell, ...]] = [
        (granted.format(pem=models), *(_claim(of_run.get(kind)) for of_run in found))
        for kind, granted in GRANTED.items()
        if any(kind in of_run for of_run in found)
    ]
    return Table(("if", *(f"run {index}" for index in range(1, len(runs) + 1))), tuple(rows))


def _claim(one: Claim | None) -> Cell:
    if one is None:
        return ""
    bound = claim_bound(one)
    return bound if one.verdict is None else Verdict(MARKS[one.verdict], f"{one.verdict}: {bound}")


def _differences(runs: Sequence[CaseRun]) -> Iterator[Block]:
    """The settings in which the runs differ from the first, a row each."""
    first = runs[0].result.config
    changed = [setting_differences(first, run.result.config) for run in runs]
    names = list(dict.fromkeys(name for settings in changed for name in settings))
    if not names:
        yield Paragraph("The runs have the same settings.", tone="quiet")
        return
    own = {name: pair[0] for settings in changed for name, pair in settings.items()}
    values = [
        [_value(settings.get(name, (None, own[name]))[1]) for name in names] for settings in changed
    ]
    if len(runs) <= MOST_IN_FULL:
        columns = [f"run {index}" for index in range(1, len(runs) + 1)]
        of_settings = zip(*values, strict=True)
        across = ((name, *cells) for name, cells in zip(names, of_settings, strict=True))
        yield Table(("setting", *columns), tuple(across))
        return
    down = ((run.name, *cells[:MOST_SETTINGS]) for run, cells in zip(runs, values, strict=True))
    yield Table(("run", *names[:MOST_SETTINGS]), tuple(down))
    if (left := len(names) - MOST_SETTINGS) > 0:
        yield Paragraph(f"{left} settings more differ.", tone="quiet")


def _value(value: object) -> str:
    """A setting's value, as configurations have it; a dash where it is left out."""
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else str(value)
