"""The list of kept runs."""

from collections.abc import Sequence
from html import escape

from pemviz.panel.recordings import RunEntry
from pemviz.panel.views.elements import block, grid, number, quiet
from pemviz.reports.html import warning

MOST_COMPLAINTS = 10
TABLE_PX = 260
SHOWN_NOTES = 120
ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"


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
            f"{escape(entry.name)}{_notes(entry)}",
            f"{escape(entry.method)}<br>{escape(entry.metric)}<br>seed {entry.seed}",
            number(entry.probability),
            _reliability(entry),
            escape(entry.status) + ("" if entry.has_recording else "<br>no .rrd"),
        ]
        for entry in entries
    ]
    header = ("run, notes", "method", "P(violation)", "reliable?", "status")
    table = grid(header, lines, name="Recordings")
    table = f"<div style='max-height:{TABLE_PX}px;overflow-y:auto'>{table}</div>"
    return block(table + complaints + quiet(f"Folder: {folder}"))


def _notes(entry: RunEntry) -> str:
    """The first words of a run's notes; all of them where the pointer rests."""
    words = " ".join(entry.notes.split())
    if not words:
        return ""
    short = words if len(words) <= SHOWN_NOTES else words[: SHOWN_NOTES - 1] + ELLIPSIS
    return f"<br><i title='{escape(words, quote=True)}'>{escape(short)}</i>"


def _reliability(entry: RunEntry) -> str:
    """Whether the estimate may decide anything; why not stands where the pointer rests."""
    if entry.probability is None:
        return "no estimate"
    if not entry.unreliable:
        return "\N{CHECK MARK} yes"
    reasons = escape("; ".join(entry.unreliable), quote=True)
    return f"<span title='{reasons}'>\N{WARNING SIGN} unreliable</span>"


def delete_question(name: str) -> str:
    """What is lost if a run is deleted."""
    words = "Its result, rollouts, recording and notes are deleted. Nothing brings them back."
    return block(f"<b>{escape(name)}</b>" + quiet(words))


def viewer_link(address: str, *, name: str) -> str:
    """A link to the viewer, opened in a new tab."""
    return block(
        f"<a href='{escape(address, quote=True)}' target='_blank' rel='noopener'>"
        f"Open {escape(name)} in rerun's viewer (new tab)</a>"
    )
