"""The page of a safety case: claim, argument, evidence, assumptions, data, provenance.

One run in full, or several side by side and then in full. Evidence is what
:mod:`pemviz.reports.run_document` tells of a run; what is here argues from it.
"""

from collections.abc import Iterator, Mapping, Sequence

from pemviz._version import __version__
from pemviz.colors import BLUE
from pemviz.config import SHIPPED_SIMULATORS
from pemviz.pem import PemCard
from pemviz.pem.model_files import is_python
from pemviz.reports import document as doc
from pemviz.reports import html
from pemviz.reports.argument import Argument, argument_of_budget, argument_of_runs
from pemviz.reports.argument_picture import argument_svg
from pemviz.reports.budget_document import budget_document
from pemviz.reports.case_runs import CaseRun
from pemviz.reports.charts import gap_chart, miss_chart, runs_chart
from pemviz.reports.document import Block, Document, Paragraph, Section, Table, facts, figure
from pemviz.reports.escape import printable_lines
from pemviz.reports.estimate_words import NAMELESS, interval_text, probability_text, range_text
from pemviz.reports.run_document import run_document, scenario_text
from pemviz.reports.safety_claims import GRANTED, Claim, Verdict, claim_sentence, claimed, claims
from pemviz.runs.reading import setting_differences
from pemviz.runs.result import RunResult
from pemviz.runs.risk_budget import JudgedBudget
from pemviz.runs.uncertainty import SourceKind, run_interval_caveats, uncertainty_budget
from pemviz.sampling.registry import by_name

MARKS: Mapping[Verdict, doc.Mark] = {"shown": "yes", "not shown": "no", "not known": "open"}
EVIDENCE = (
    (
        "The estimate and its diagnostics",
        ("answer", "rules", "rates", "diagnostics", "warnings", "models", "robustness"),
    ),
    ("How far the answer is open", ("uncertainty",)),
    ("Misses that follow each other", ("memory",)),
    ("What causes violations", ("causes", "starts", "worst")),
    ("The error model and its data", ("extrapolation",)),
)
"""Titles of what is numbered E1 to E5, and the sections of the run's document in each."""
MOST_IN_FULL = 8
"""Of more runs the rest stands side by side only."""
MOST_DRAWN = 40
MOST_SETTINGS = 5
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Of the page's content: nothing is fetched, no script runs."""
STYLE = f"""
:root {{ color-scheme: light; }}
* {{ box-sizing: border-box; }}
body {{ margin: 0; background: #fff; font: 15px/1.5 system-ui, "Segoe UI", Roboto, sans-serif; }}
main {{ max-width: 1060px; margin: 0 auto; padding: 28px 24px 60px; }}
h1 {{ font-size: 27px; line-height: 1.25; margin: 0 0 4px; }}
h2 {{ font-size: 20px; margin: 38px 0 8px; padding-bottom: 4px; border-bottom: 2px solid #d5dae0; }}
main p, main li {{ max-width: 82ch; }} figure {{ max-width: 780px; }}
.head {{ border: 1px solid #cbd2d9; border-radius: 6px; padding: 16px 20px 10px; margin: 16px 0;
  columns: 2 380px; column-gap: 28px; }}
.argument {{ margin: 12px 0; }}
.head figure, .head li, .head p {{ break-inside: avoid; }}
nav {{ margin: 10px 0 0; font-size: 14px; }}
nav a {{ color: {BLUE}; margin-right: 14px; text-decoration: none; }}
section.run {{ margin-top: 52px; border-top: 4px solid #1f2933; padding-top: 22px; }}
footer {{ margin-top: 46px; color: #52606d; font-size: 13px; border-top: 1px solid #e1e6eb;
  padding-top: 8px; }}
@page {{ size: A4; margin: 16mm 15mm 18mm;
  @bottom-right {{ content: counter(page) " / " counter(pages); font: 9pt sans-serif;
    color: #52606d; }} }}
@media print {{
  body {{ font-size: 9.6pt; }} main {{ max-width: none; padding: 0; }} nav {{ display: none; }}
  h1 {{ font-size: 17pt; }} h2 {{ font-size: 13pt; margin-top: 20pt; }}
  h2:not(:has(+ .argument)), h3, h4 {{ break-after: avoid; }}
  figure, tr, .head, .warn, li {{ break-inside: avoid; }}
  section.run {{ break-before: page; margin: 0; border: 0; padding: 0; }}
}}
"""


def safety_case_page(
    runs: Sequence[CaseRun], *, below: float | None = None, budget: JudgedBudget | None = None
) -> str:
    """The whole page as HTML, of runs or of a risk budget. What cannot be printed is replaced.

    Args:
        runs: One at least, but for a budget that names none.
        below: The failure probability that is to be claimed, if one is named.
        budget: Stands first; runs are then its evidence.
    """
    if budget is not None:
        title, below_title = f"Safety case: {budget.budget.name}", "Risk budget, then its evidence"
        body = _budget(budget) + _many(runs, below=below)
    elif len(runs) == 1:
        config = runs[0].result.config
        specified = ", ".join(rule.name for rule in config.rules) or config.spec
        title, below_title = f"Safety case evidence: {specified}", f"Run {runs[0].name}"
        body = _run(runs[0], below=below, prefix="")
    else:
        title = f"Safety case evidence: {len(runs)} runs"
        below_title = "Side by side, then each in full"
        body = _many(runs, below=below)
    body = f"<h1>{html.words(title)}</h1>{html.paragraph(below_title, 'quiet')}{body}"
    footer = html.words(
        f"Made by pemviz {__version__} from what the runs kept; the page fetches nothing and runs "
        "nothing. Every figure is conditional on the assumptions that it names."
    )
    page = (
        "<!DOCTYPE html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n"
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        "<meta name='viewport' content='width=device-width, initial-scale=1'>\n"
        "<meta name='referrer' content='no-referrer'>\n"
        f"<title>{html.words(title)}</title>\n<style>{STYLE}{html.SHEET}</style>\n</head>\n"
        f"<body>\n<main class='{html.ROOT}'>\n{body}<footer>{footer}</footer>\n</main>\n"
        "</body>\n</html>\n"
    )
    return f"{printable_lines(page)}\n"


def _many(runs: Sequence[CaseRun], *, below: float | None) -> str:
    """Side by side where there are several, then each in full."""
    body = html.sections_html(_side_by_side(runs, below=below)) if len(runs) > 1 else ""
    for index, run in enumerate(runs[:MOST_IN_FULL], start=1):
        full = _run(run, below=below, prefix=f"r{index}-")
        name = html.words(run.name)
        body += f"<section class='run'><h1>Run {index}: {name}</h1>{full}</section>"
    if (left := len(runs) - MOST_IN_FULL) > 0:
        body += html.paragraph(f"The other {left} runs stand in the table above only.", "quiet")
    return body


def _budget(judged: JudgedBudget) -> str:
    """Is it met, hazard by hazard, and the argument drawn."""
    sections = {section.key: section for section in budget_document(judged).sections}
    first, after = sections.pop("verdict"), sections.pop("next")
    head = html.blocks_html(first.full) + html.heading(after.title) + html.blocks_html(after.full)
    picture = _picture(argument_of_budget(judged))
    parts = "".join(
        f"<h2>{html.words(section.title)}</h2>{html.blocks_html(section.full)}"
        for section in sections.values()
    )
    return f"<div class='head'>{head}</div><h2>Argument</h2>{picture}{parts}"


def _picture(argument: Argument) -> str:
    """The argument drawn, with how to read it."""
    how = (
        "To the right of each goal stands what supports it, beneath it what it takes as given; "
        "red with a diamond: a claim that does not hold, or is not known. pemviz report --gsn "
        "writes it for other tools, and --check judges it again."
    )
    drawn = argument_svg(argument, title="The argument as a tree of goals")
    return f"<div class='argument'>{drawn}</div>{html.paragraph(how, 'quiet')}"


def _run(run: CaseRun, *, below: float | None, prefix: str) -> str:
    result, config, document = run.result, run.result.config, run_document(run.result)
    named = ", ".join(rule.name for rule in config.rules) or config.spec
    about = f"{named}; {scenario_text(config)}; error model {result.pem.name}; seed {config.seed}"
    no_plan = (Paragraph("This run made no plan: a run without --no-plan makes one."),)
    evidence = (html.heading(e.title) + html.blocks_html(e.full) for e in _evidence(run, document))
    parts = [
        ("Claim", html.blocks_html(_claim_blocks(result, below=below))),
        (
            "Argument",
            html.blocks_html([doc.Bullets(_argument(result), numbered=True)])
            + _picture(argument_of_runs([run], below=below)),
        ),
        ("Evidence", "".join(evidence)),
        ("Assumptions, and what each changes", html.blocks_html([_assumptions(result)])),
        ("What to measure next", html.blocks_html(document.blocks("plan") or no_plan)),
        ("Data and model", html.blocks_html(_data_and_model(run))),
        ("Provenance, and how to reproduce it", html.blocks_html(_reproduce(run, document))),
    ]
    links = "".join(
        f"<a href='#{prefix}{index}'>{html.words(name)}</a>"
        for index, (name, _) in enumerate(parts, start=1)
    )
    body = "".join(
        f"<h2 id='{prefix}{index}'>{index}. {html.words(name)}</h2>{text}"
        for index, (name, text) in enumerate(parts, start=1)
    )
    return (
        html.paragraph(about, "quiet")
        + f"<div class='head'>{html.blocks_html(_head(run, document, below=below))}</div>"
        + f"<nav>{links}</nav>{body}"
    )


def _head(run: CaseRun, document: Document, *, below: float | None) -> tuple[Block, ...]:
    """How likely, how sure, resting on what, what next: all that a hurried reader sees."""
    result = run.result
    claim = Paragraph(claim_sentence(result, below=below))
    if result.estimate is None:
        return (claim,)
    doubts = tuple(doc.Caution(f"Do not quote it: {why}.") for why in run_interval_caveats(result))
    return (
        *document.blocks("answer", "given", brief=True),
        *doubts,
        claim,
        *document.blocks("uncertainty", "memory", brief=True),
        *(Paragraph(s.title, tone="strong") for s in document.choose(("plan",))),
        *document.blocks("plan", brief=True),
    )


def _claim_blocks(result: RunResult, *, below: float | None) -> tuple[Block, ...]:
    found = claims(result, below=below)
    if not found:
        return (Paragraph(claim_sentence(result, below=below)),)
    columns = ["if", "by", "its probability is below", "why not, or what would tell"]
    rows: list[tuple[doc.Cell, ...]] = []
    for one in found:
        judged = () if one.verdict is None else (doc.Verdict(MARKS[one.verdict], one.verdict),)
        rows.append((one.granted, one.name, one.bound_text, one.note, *judged))
    columns += [] if below is None else [f"below {below:g}"]
    about = Paragraph(f"How likely it is that {claimed(result)}:", "quiet")
    return about, Table(tuple(columns), tuple(rows))


def _sampling_step(result: RunResult) -> str:
    """How rollouts lead to the probability; as the method that gave the answer has it."""
    method = result.config.method if result.estimate is None else result.estimate.method
    if by_name(method).interval_basis == "counts":
        return (
            f"Method {method} samples rollouts from the error model itself and counts those that "
            "violate; the interval is the exact binomial one: E1."
        )
    return (
        f"Violations are far too rare to wait for: method {method} samples rollouts in which "
        "they are common and weights each by how much likelier it is under the error model. "
        "Whether the weights can be trusted: E1."
    )


def _argument(result: RunResult) -> tuple[str, ...]:
    """Why the evidence carries the claim, step by step."""
    config, data = result.config, result.pem.data
    rules = "; ".join(f"{rule.name} {rule.formula!r}" for rule in config.rules)
    what = f"one of the rules {rules}" if rules else repr(config.spec)
    origin = "stated" if data.startswith(NAMELESS) else f"learned from {data}"
    perception = (
        f"Perception is the error model {result.pem.name}: how likely the detector misses, given "
        f"what it looks at, {origin}. How far that may be wrong: E2, E5."
    )
    if result.is_of_detector_itself:
        perception = (
            "Perception is the detector itself, which looks at rendered images; that it would say "
            "the same on the road is an assumption."
        )
    random_in_it = "Everything but perception is deterministic in it (assumptions below)."
    if result.latents is not None:
        random_in_it = f"Random in it beside perception: {result.latents} (assumptions below)."
    return (
        f"What may go wrong is stated exactly: a run violates {what}, decided by the "
        "Boolean semantics of Signal Temporal Logic, strict comparisons as they are written.",
        f"The system is the scenario: {scenario_text(config)}. {random_in_it}",
        perception,
        _sampling_step(result),
        "So the failure probability follows, if the error model is right (E1); how far it is open "
        "if it is not, source by source: E2. What causes violations, so that experts can judge "
        "whether the chains are plausible: E4.",
    )


def _evidence(run: CaseRun, document: Document) -> Iterator[Section]:
    for number, (title, keys) in enumerate(EVIDENCE, start=1):
        blocks = [*document.blocks(*keys)]
        if number == 4:
            blocks[1:1] = _violations(run)
        nothing = "Nothing speaks against the error model where the scenario goes."
        if run.result.is_of_detector_itself:
            nothing = "There is no error model: the detector itself is in the loop."
        blocks = blocks or [Paragraph(nothing)]
        yield Section(f"E{number}", f"E{number}. {title}", (), tuple(blocks))


def _violations(run: CaseRun) -> tuple[Block, ...]:
    """Gaps of the likeliest violations, and when misses that matter fall."""
    explanation, found, dt_s = run.result.explanation, run.violations, run.result.config.dt_s
    over_time = () if explanation is None else explanation.miss_probability_by_step
    gaps = None if found is None else gap_chart(found.gap_m, found.missed, found.share, dt_s=dt_s)
    return (*figure(gaps), *figure(miss_chart(over_time, dt_s=dt_s) if any(over_time) else None))


def _assumptions(result: RunResult) -> Table:
    """Every assumption, and by how much the answer changes if it is given up."""
    rows = tuple(_assumption_row(text, result) for text in result.assumptions)
    return Table(("assumed", "what it changes", "what would narrow it"), rows)


def _assumption_row(text: str, result: RunResult) -> tuple[str, str, str]:
    kinds: Sequence[SourceKind] = ()
    if text.startswith(("misses are independent", "given the state, misses hang")):
        kinds = ("memory",)
    elif "model holds where" in text:
        kinds = ("refits", "model-classes", "data")
    sources = [source for source in uncertainty_budget(result) if source.kind in kinds]
    if not sources:
        return text, "not known from this run", "Not quantified here; to be argued from elsewhere."
    worth = [
        f"{one.name}: {range_text(one.low, one.high) if one.high is not None else 'not looked at'}"
        for one in sources
    ]
    narrowed = dict.fromkeys(source.narrowed_by for source in sources)
    return text, "; ".join(worth), "; ".join(narrowed)


def _data_and_model(run: CaseRun) -> tuple[Block, ...]:
    info, card = run.result.pem, run.card
    rows = [
        ("error model", info.name),
        ("trained on", info.data),
        ("digest (SHA-256)", doc.Verbatim(info.digest)),
    ]
    if card is None:
        note = "The model's card is not at hand here, or the model has changed since the run."
        return facts(rows), Paragraph(note, tone="quiet")
    return (facts([*rows, *_card_rows(card)]),)


def _card_rows(card: PemCard) -> list[tuple[str, str]]:
    cells = card.support.get("cells", ())
    obstacles = sum(int(cell[-2]) for cell in cells)
    missed = sum(int(cell[-1]) for cell in cells)
    rows = [
        ("kind of model", card.model),
        ("training table (SHA-256)", doc.Verbatim(card.data_digest or "not stated")),
        ("licence", card.licence),
        ("recipe", card.recipe),
        ("seed of its training", str(card.seed)),
        *((f"score: {name}", f"{value:.4f}") for name, value in card.scores.items()),
    ]
    if obstacles:
        share = f"{missed:,} of {obstacles:,} training obstacles ({missed / obstacles:.1%})"
        rows.append(("missed by the detector", share))
    return rows


def _reproduce(run: CaseRun, document: Document) -> tuple[Block, ...]:
    digests = tuple((f"{name} (SHA-256)", doc.Verbatim(v)) for name, v in run.digests.items())
    version = run.result.versions.get("pemviz", "in the same version")
    again, versions = "To have the same figures again", f"pemviz {version} with the versions above"
    allowed = " --allow-python" if is_python(run.result.config.pem) else ""
    how: tuple[Block, ...] = (
        Paragraph(
            f"{again}: save the configuration below as config.toml, install {versions}, and run"
        ),
        doc.Code(f"pemviz record --config config.toml{allowed}"),
    )
    own = run.result.simulator
    if own is not None and run.result.config.simulator in SHIPPED_SIMULATORS:
        # which the program had in place of what the configuration names
        words = f"{again}: run the program that put simulator {own.name} ({own.code}) together "
        words += f"with the configuration below, with {versions}; no command does"
        how = (Paragraph(words),)
    return (
        *document.blocks("provenance"),
        *((facts(digests),) if digests else ()),
        *how,
        *document.blocks("configuration"),
    )


def _side_by_side(runs: Sequence[CaseRun], *, below: float | None) -> Iterator[Section]:
    caption = "Estimates with their intervals (sampling alone; dotted: no interval at its level)"
    caption += "" if below is None else f"; the dashed line is {below:g}"
    if len(runs) > MOST_DRAWN:
        caption += f"; the first {MOST_DRAWN} of {len(runs)} runs"
    named = [(f"{i}. {run.name}", run.result) for i, run in enumerate(runs[:MOST_DRAWN], start=1)]
    rows = tuple((str(index), *_row(run)) for index, run in enumerate(runs, start=1))
    chart = figure(runs_chart(named, limit=below), caption=f"{caption}.")
    columns = (
        "",
        "run",
        "probability",
        "interval",
        "refits",
        "model classes",
        "data alone",
        "sampling",
    )
    yield Section("answers", "Side by side", (), (*chart, Table(columns, rows)))
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
    found = [{one.kind: one for one in claims(run.result, below=below)} for run in runs]
    models = ", ".join(dict.fromkeys(run.result.pem.name for run in runs))
    rows: list[tuple[doc.Cell, ...]] = [
        (granted.format(pem=models), *(_claim_cell(of_run.get(kind)) for of_run in found))
        for kind, granted in GRANTED.items()
        if any(kind in of_run for of_run in found)
    ]
    return Table(("if", *(f"run {index}" for index in range(1, len(runs) + 1))), tuple(rows))


def _claim_cell(one: Claim | None) -> doc.Cell:
    if one is None or one.verdict is None:
        return "" if one is None else one.bound_text
    return doc.Verdict(MARKS[one.verdict], f"{one.verdict}: {one.bound_text}")


def _differences(runs: Sequence[CaseRun]) -> Iterator[Block]:
    """The settings in which the runs differ from the first, a row each."""
    first = runs[0].result.config
    changed = [setting_differences(first, run.result.config) for run in runs]
    names = list(dict.fromkeys(name for settings in changed for name in settings))
    if not names:
        yield Paragraph("The runs have the same settings.", tone="quiet")
        return
    own = {name: pair[0] for settings in changed for name, pair in settings.items()}

    def text_of(value: object) -> str:
        """As configurations have it; a dash where it is left out."""
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return "-" if value is None else text

    values = [
        [text_of(settings.get(name, (None, own[name]))[1]) for name in names]
        for settings in changed
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
