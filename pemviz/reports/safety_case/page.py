"""The page: one run in full, or several side by side and then in full."""

from collections.abc import Sequence

from pemviz._version import __version__
from pemviz.colors import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from pemviz.config import ExperimentConfig
from pemviz.reports.estimate_text import interval_text, probability_text
from pemviz.reports.pictures.answers import AnswerRow, answers_plot
from pemviz.reports.safety_case.case import CaseRun
from pemviz.reports.safety_case.claims import GRANTED, Claim, claims
from pemviz.reports.safety_case.evidence import evidence
from pemviz.reports.safety_case.html import (
    document,
    figure,
    html_table,
    paragraph,
    table,
    words,
)
from pemviz.reports.safety_case.sections import (
    argument,
    assumptions,
    claim_section,
    data_section,
    headline,
    next_section,
    provenance,
    scenario_text,
    verdict_mark,
)
from pemviz.reports.uncertainty_text import ends_text
from pemviz.runs.same_run import setting_differences
from pemviz.runs.trust import run_interval_caveats
from pemviz.runs.uncertainty import uncertainty_budget

MOST_IN_FULL = 8
"""Of more runs the rest stands side by side only."""
MOST_DRAWN = 40
MOST_SETTINGS = 5
COLORS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY)
FOOTER = (
    "Made by pemviz {version} from what the runs kept; the page fetches nothing and runs nothing. "
    "Every figure is conditional on the assumptions that it names."
)


def safety_case_page(runs: Sequence[CaseRun], *, below: float | None = None) -> str:
    """The whole page as HTML.

    Args:
        runs: At least one.
        below: The failure probability that is to be claimed, if one is named.
    """
    if len(runs) == 1:
        title = f"Safety case evidence: {_asked(runs[0].result.config)}"
        body = _title(title, f"Run {runs[0].name}") + _sections(runs[0], below=below, prefix="")
    else:
        title = f"Safety case evidence: {len(runs)} runs"
        body = _title(title, "Side by side, then each in full")
        body += _side_by_side(runs, below=below)
        for index, run in enumerate(runs[:MOST_IN_FULL], start=1):
            full = _sections(run, below=below, prefix=f"r{index}-")
            body += f"<section class='run'><h1>Run {index}: {words(run.name)}</h1>{full}</section>"
        if len(runs) > MOST_IN_FULL:
            left = len(runs) - MOST_IN_FULL
            body += paragraph(f"The other {left} runs stand in the table above only.", kind="quiet")
    footer = f"<footer>{words(FOOTER.format(version=__version__))}</footer>"
    return document(title=title, body=body + footer)


def _title(title: str, below: str) -> str:
    return f"<h1>{words(title)}</h1>{paragraph(below, kind='quiet')}"


def _asked(config: ExperimentConfig) -> str:
    """The specification, or the names of the rules that make it up."""
    return ", ".join(rule.name for rule in config.rules) or config.spec


def _sections(run: CaseRun, *, below: float | None, prefix: str) -> str:
    result = run.result
    config = result.config
    asked = f"{_asked(config)}; {scenario_text(config)}; error model {result.pem.name}; seed "
    parts = (
        ("Claim", claim_section(result, below=below)),
        ("Argument", argument(result)),
        ("Evidence", evidence(run, below=below)),
        ("Assumptions, and what each is worth", assumptions(result)),
        ("What to measure next", next_section(result)),
        ("Data and model", data_section(run)),
        ("Provenance, and how to reproduce it", provenance(run)),
    )
    links = "".join(
        f"<a href='#{prefix}{index}'>{words(name)}</a>"
        for index, (name, _) in enumerate(parts, start=1)
    )
    body = "".join(
        f"<h2 id='{prefix}{index}'>{index}. {words(name)}</h2>{text}"
        for index, (name, text) in enumerate(parts, start=1)
    )
    return (
        paragraph(f"{asked}{config.seed}", kind="quiet")
        + headline(run, below=below)
        + f"<nav>{links}</nav>"
        + body
    )


def _side_by_side(runs: Sequence[CaseRun], *, below: float | None) -> str:
    """Every run's answer and uncertainty, one below the other, and how their settings differ."""
    picture = answers_plot(
        [_answer_row(run, index) for index, run in enumerate(runs[:MOST_DRAWN], start=1)],
        title="Answers side by side",
        limit=below,
        width=760,
    )
    caption = "Estimates with their intervals (sampling alone; dashed: no interval at its level)"
    caption += "" if below is None else f"; the dashed line is {below:g}"
    if len(runs) > MOST_DRAWN:
        caption += f"; the first {MOST_DRAWN} of {len(runs)} runs"
    return (
        "<h2>Side by side</h2>"
        + figure(picture, f"{caption}.")
        + table(
            ("", "run", "probability", "interval", "refits", "families", "data alone", "trust"),
            [(str(index), *_row(run)) for index, run in enumerate(runs, start=1)],
        )
        + _differences(runs)
        + _claims_across(runs[:MOST_IN_FULL], below=below)
    )


def _claims_across(runs: Sequence[CaseRun], *, below: float | None) -> str:
    """What each run lets one claim: a row for what is granted, a column for each run."""
    found = [{claim.kind: claim for claim in claims(run.result, below=below)} for run in runs]
    models = ", ".join(dict.fromkeys(run.result.pem.name for run in runs))
    rows: list[list[str]] = []
    for kind, granted in GRANTED.items():
        own = [claim for of_run in found if (claim := of_run.get(kind)) is not None]
        if own:
            cells = [_claim_cell(of_run.get(kind)) for of_run in found]
            rows.append([words(granted.format(pem=models)), *cells])
    what = "Bounds" if below is None else f"Claims of less than {below:g}"
    header = ("if", *(f"run {index}" for index in range(1, len(runs) + 1)))
    return f"<h3>{words(what)}</h3>{html_table(header, rows)}"


def _claim_cell(claim: Claim | None) -> str:
    if claim is None:
        return ""
    bound = "not known" if claim.bound is None else f"{claim.bound:.2g}"
    return bound if claim.verdict is None else f"{verdict_mark(claim.verdict)}<br>{bound}"


def _answer_row(run: CaseRun, index: int) -> AnswerRow:
    estimate, name = run.result.estimate, f"{index}. {run.name}"
    if estimate is None:
        return AnswerRow(name, None, None, None, COLORS[0])
    return AnswerRow(
        name,
        estimate.probability,
        estimate.ci_low,
        estimate.ci_high,
        COLORS[(index - 1) % len(COLORS)],
        holds=not run_interval_caveats(run.result),
    )


def _row(run: CaseRun) -> tuple[str, ...]:
    result, estimate = run.result, run.result.estimate
    if estimate is None:
        return (run.name, f"none: the run {result.status}", "", "", "", "", "")
    ends = {
        source.kind: " to ".join(ends_text(source)) if source.high is not None else "-"
        for source in uncertainty_budget(result)
    }
    against = run_interval_caveats(result)
    return (
        run.name,
        probability_text(estimate),
        interval_text(estimate, caveats=()),
        ends.get("refits", "-"),
        ends.get("families", "-"),
        ends.get("data", "-"),
        f"unreliable: {against[0]}" if against else "no warning",
    )


def _differences(runs: Sequence[CaseRun]) -> str:
    """The settings in which the runs differ from the first, a row each."""
    first = runs[0].result.config
    names: dict[str, None] = {}
    changed = [setting_differences(first, run.result.config) for run in runs]
    for settings in changed:
        names |= dict.fromkeys(settings)
    if not names:
        return paragraph("The runs have the same settings.", kind="quiet")
    own = {name: pair[0] for settings in changed for name, pair in settings.items()}
    values = [
        [_value(settings.get(name, (None, own[name]))[1]) for name in names] for settings in changed
    ]
    title = "<h3>Settings that differ</h3>"
    if len(runs) <= MOST_IN_FULL:
        columns = [f"run {index}" for index in range(1, len(runs) + 1)]
        of_settings = zip(*values, strict=True)
        across = [(name, *cells) for name, cells in zip(names, of_settings, strict=True)]
        return title + table(("setting", *columns), across)
    shown = list(names)[:MOST_SETTINGS]
    down = [(run.name, *cells[:MOST_SETTINGS]) for run, cells in zip(runs, values, strict=True)]
    left = len(names) - len(shown)
    told = paragraph(f"{left} settings more differ.", kind="quiet") if left else ""
    return title + table(("run", *shown), down) + told


def _value(value: object) -> str:
    """A setting's value, as configurations have it; a dash where it is left out."""
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else str(value)
