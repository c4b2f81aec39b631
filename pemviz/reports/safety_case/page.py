"""The page of a safety case: one run in full, or several side by side and then in full."""

from collections.abc import Iterator, Sequence

from pemviz._version import __version__
from pemviz.colors import BLUE
from pemviz.config import ExperimentConfig
from pemviz.reports.document import Bullets, Document, Paragraph, Section
from pemviz.reports.escape import printable_lines
from pemviz.reports.html import (
    ROOT,
    SHEET,
    blocks_html,
    heading,
    paragraph,
    sections_html,
    words,
)
from pemviz.reports.run_document import run_document
from pemviz.reports.run_words import scenario_text
from pemviz.reports.safety_case.case import CaseRun
from pemviz.reports.safety_case.comparison import MOST_IN_FULL, side_by_side
from pemviz.reports.safety_case.sections import (
    argument,
    assumptions,
    claim,
    data_and_model,
    evidence,
    head,
    reproduce,
)

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
  h2, h3, h4 {{ break-after: avoid; }} figure, tr, .head, .warn, li {{ break-inside: avoid; }}
  section.run {{ break-before: page; margin: 0; border: 0; padding: 0; }}
}}
"""
FOOTER = (
    "Made by pemviz {version} from what the runs kept; the page fetches nothing and runs nothing. "
    "Every figure is conditional on the assumptions that it names."
)


def safety_case_page(runs: Sequence[CaseRun], *, below: float | None = None) -> str:
    """The whole page as HTML. What cannot be printed is replaced.

    Args:
        runs: At least one.
        below: The failure probability that is to be claimed, if one is named.
    """
    if len(runs) == 1:
        title = f"Safety case evidence: {_asked(runs[0].result.config)}"
        body = _title(title, f"Run {runs[0].name}") + _run(runs[0], below=below, prefix="")
    else:
        title = f"Safety case evidence: {len(runs)} runs"
        body = _title(title, "Side by side, then each in full")
        body += sections_html(side_by_side(runs, below=below))
        for index, run in enumerate(runs[:MOST_IN_FULL], start=1):
            full = _run(run, below=below, prefix=f"r{index}-")
            body += f"<section class='run'><h1>Run {index}: {words(run.name)}</h1>{full}</section>"
        if len(runs) > MOST_IN_FULL:
            left = len(runs) - MOST_IN_FULL
            body += paragraph(f"The other {left} runs stand in the table above only.", "quiet")
    footer = f"<footer>{words(FOOTER.format(version=__version__))}</footer>"
    page = (
        "<!DOCTYPE html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n"
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        "<meta name='viewport' content='width=device-width, initial-scale=1'>\n"
        "<meta name='referrer' content='no-referrer'>\n"
        f"<title>{words(title)}</title>\n<style>{STYLE}{SHEET}</style>\n</head>\n"
        f"<body>\n<main class='{ROOT}'>\n{body}{footer}\n</main>\n</body>\n</html>\n"
    )
    return f"{printable_lines(page)}\n"


def _title(title: str, below: str) -> str:
    return f"<h1>{words(title)}</h1>{paragraph(below, 'quiet')}"


def _asked(config: ExperimentConfig) -> str:
    """The specification, or the names of the rules that make it up."""
    return ", ".join(rule.name for rule in config.rules) or config.spec


def _run(run: CaseRun, *, below: float | None, prefix: str) -> str:
    """A run's head, links to its sections, and these."""
    config, document = run.result.config, run_document(run.result)
    asked = f"{_asked(config)}; {scenario_text(config)}; error model {run.result.pem.name}; seed "
    parts = [
        (section.title, blocks_html(section.full)) for section in _sections(run, document, below)
    ]
    told = (heading(e.title) + blocks_html(e.full) for e in evidence(run, document))
    parts.insert(2, ("Evidence", "".join(told)))
    links = "".join(
        f"<a href='#{prefix}{index}'>{words(name)}</a>"
        for index, (name, _) in enumerate(parts, start=1)
    )
    body = "".join(
        f"<h2 id='{prefix}{index}'>{index}. {words(name)}</h2>{text}"
        for index, (name, text) in enumerate(parts, start=1)
    )
    return (
        paragraph(f"{asked}{config.seed}", "quiet")
        + f"<div class='head'>{blocks_html(head(run, document, below=below))}</div>"
        + f"<nav>{links}</nav>{body}"
    )


def _sections(run: CaseRun, document: Document, below: float | None) -> Iterator[Section]:
    """All but the evidence."""
    no_plan = (Paragraph("This run made no plan: pemviz record --plan makes one."),)
    named = (
        ("Claim", claim(run.result, below=below)),
        ("Argument", (Bullets(argument(run.result), numbered=True),)),
        ("Assumptions, and what each is worth", (assumptions(run.result),)),
        ("What to measure next", document.blocks("plan") or no_plan),
        ("Data and model", data_and_model(run)),
        ("Provenance, and how to reproduce it", reproduce(run, document)),
    )
    return (Section(title, title, (), blocks) for title, blocks in named)
