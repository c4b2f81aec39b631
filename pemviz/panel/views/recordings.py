"""The list of kept runs."""

from collections.abc import Sequence
from html import escape

from pemviz.panel.recordings import RunEntry
from pemviz.panel.views.words import block, grid, number, quiet


def recordings_table(entries: Sequence[RunEntry], *, folder: str) -> str:
    """One line a run."""
    if not entries:
        return block(quiet(f"There are no runs in {folder} yet. Press Run in the Experiment tab."))
    lines = [
        [
            escape(entry.name),
            f"{escape(entry.method)}<br>{escape(entry.metric)}",
            number(entry.probability),
            str(entry.seed),
            escape(entry.status),
            "yes" if entry.has_recording else "no",
        ]
        for entry in entries
    ]
    header = ("run", "method, metric", "P(violation)", "seed", "status", ".rrd")
    return block(grid(header, lines, name="Recordings") + quiet(f"Folder: {folder}"))


def viewer_link(address: str, *, name: str) -> str:
    """A link to the viewer, opened in a new tab."""
    return block(
        f"<a href='{escape(address, quote=True)}' target='_blank' rel='noopener'>"
        f"Open {escape(name)} in rerun's viewer (new tab)</a>"
    )
