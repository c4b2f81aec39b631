"""A reproduction as one recording for the rerun viewer."""

import os
from pathlib import Path

from pemviz.recording.pages import Page, write_pages
from pemviz.reproduce.carry_out import Reproduction
from pemviz.reproduce.experiments import LeastSafeSearch
from pemviz.reproduce.figures import Artefact

TITLES = {
    "table1": "Table I",
    "table2": "Table II",
    "table3": "Table III",
    "learned_proposal": "Learned proposal",
    "least_safe": "Least safe",
}


def write_recording(made: Reproduction, path: Path) -> None:
    """Write all tables and figures, a tab each; whole or not at all.

    Raises:
        OSError: It cannot be put in its place.
        RunError: It cannot be written.
    """
    pages = [Page(name="all", title="All", markdown=_without_pictures(made.page))]
    pages += [_page(one, made.search) for one in made.artefacts]
    partial = path.with_name(f".{path.name}.partial")
    try:
        write_pages(partial, pages, name="the paper reproduced")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _page(one: Artefact, search: LeastSafeSearch | None) -> Page:
    title = TITLES.get(one.name, one.name.replace("_", " ").capitalize())
    text = _without_pictures(one.markdown)
    if one.name != "least_safe" or search is None:
        return Page(name=one.name, title=title, markdown=text, png=one.png)
    return Page(
        name=one.name,
        title=title,
        markdown=text,
        png=one.png,
        series={found.metric: found.gap_m for found in search.found},
        series_title="Gap [m] against time",
        dt_s=search.dt_s,
    )


def _without_pictures(markdown: str) -> str:
    """The viewer shows a picture beside the text, not in it."""
    return "\n".join(line for line in markdown.splitlines() if not line.startswith("!["))
