"""The list of kept runs."""

from collections.abc import Sequence
from html import escape

from pemviz.panel.recordings import RunEntry
from pemviz.reports.pictures.html import block, grid, number, quiet, warning

MOST_COMPLAINTS = 10


def recordings_table(
    entries: Sequence[RunEntry], *, folder: str, damaged: Sequence[str] = ()
) -> str:
    """One line a run, then what is wrong with those that cannot be read."""
    complaints = "".join(warning(words) for words in damaged[:MOST_COMPLAINTS])
    if len(damaged) > MOST_COMPLAINTS:
        complaints += warning(f"and {len(damaged) - MOST_COMPLAINTS} more damaged runs")
    if not entries:
        words = f"There are no runs in {folder} yet. Press Run in the Experiment tab."
        return block(complaints + quiet(words))
    lines = [
        [
            escape(entry.name),
            f"{escape(entry.method)}<br>{escape(entry.metric)}",
            _probability(entry),
            str(entry.seed),
            escape(entry.status),
            "yes" if entry.has_recording else "no",
        ]
        for entry in entries
    ]
    header = ("run", "method, metric", "P(violation)", "seed", "status", ".rrd")
    table = grid(header, lines, name="Recordings")
    return block(table + complaints + quiet(f"Folder: {folder}"))


def _probability(entry: RunEntry) -> str:
    """The estimate, and that it is unreliable, with the reasons where the pointer rests."""
    shown = number(entry.probability)
    if not entry.unreliable:
        return shown
    reasons = escape("; ".join(entry.unreliable), quote=True)
    return f"{shown}<br><span title='{reasons}'>\N{WARNING SIGN} unreliable</span>"


def viewer_link(address: str, *, name: str) -> str:
    """A link to the viewer, opened in a new tab."""
    return block(
        f"<a href='{escape(address, quote=True)}' target='_blank' rel='noopener'>"
        f"Open {escape(name)} in rerun's viewer (new tab)</a>"
    )
