"""The ranking as a table whose rows can be clicked."""

from html import escape

from pemviz.colors import MISSED
from pemviz.panel.ranking import RankedRow, Ranking, row
from pemviz.panel.run_data import RunData
from pemviz.reports.pictures.html import MINUS, block, cells, number, quiet
from pemviz.sampling.registry import by_name

PAGE_ROWS = 12
VIOLATED = f"<b style='color:{MISSED}'>\N{MULTIPLICATION X} yes</b>"

# A click writes the row's rank into viser's own input, as typing it would.
CLICK = (
    "(function(r){var i=document.getElementById(r.dataset.target);if(!i)return;"
    "Object.getOwnPropertyDescriptor(HTMLInputElement.prototype,'value').set.call(i,r.dataset.rank);"
    "i.dispatchEvent(new Event('input',{bubbles:true}));"
    "setTimeout(function(){i.blur();},0);})(this)"
)


def first_place(selected: int, count: int) -> int:
    """The zero-based place of the first row shown, so that the selected place is among them."""
    if count <= PAGE_ROWS:
        return 0
    return min(selected // PAGE_ROWS * PAGE_ROWS, count - PAGE_ROWS)


def ranking_table(run: RunData, ranking: Ranking, *, selected: int, target: str) -> str:
    """A page of rows around the selected place; ``target`` is the rank input's element id."""
    count = int(ranking.order.size)
    if not count:
        return block(quiet("No rollouts yet."))
    start = first_place(selected, count)
    unit = "" if ranking.metric == "agm" else " [m]"
    header = ("rank", f"robustness{unit}", "violated", "log weight [nats]", "misses", "stage")
    head = "".join(f"<th style='{_CELL};color:#52606d;font-weight:500'>{h}</th>" for h in header)
    lines: list[str] = []
    for place in range(start, min(start + PAGE_ROWS, count)):
        entry = row(run, ranking, place)
        verdict = (
            f"<b style='color:{MISSED}'>\N{MULTIPLICATION X} yes</b>" if entry.violated else "no"
        )
        values = (
            str(entry.rank), robustness_text(entry.robustness), verdict, weight_text(run, entry),
            str(entry.misses), str(entry.stage),
        )  # fmt: skip
        mark = "background:#dbeafe;font-weight:600;" if place == selected else ""
        lines.append(
            f"<tr role='button' data-rank='{entry.rank}' data-target='{escape(target, quote=True)}'"
            f" aria-selected='{'true' if place == selected else 'false'}' onclick=\"{CLICK}\""
            f" style='border-top:1px solid #e4e7eb;cursor:pointer;{mark}'>"
            f"{cells(values, style=_CELL)}</tr>"
        )
    shown = (
        f"Ranks {start + 1} to {start + len(lines)} of {count:,} under {ranking.metric}. "
        "Click a row, or press the up and down arrow keys; type a rank to jump. In the scene, "
        "flat blue marks on the road say where the camera detected the car ahead, upright crosses "
        "where it missed; in the blue strip a detection brakes hard, the line is the 2 m limit."
    )
    if run.kept < run.simulated:
        shown += (
            f" Of {run.simulated:,} rollouts the {run.kept:,} least robust under "
            f"{run.config.metric} are kept here."
        )
    return block(
        f"<table aria-label='Ranking' style='border-collapse:collapse;width:100%;"
        f"font-size:11.5px;font-variant-numeric:tabular-nums'><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table>{quiet(shown)}"
    )


def weight_text(run: RunData, entry: RankedRow) -> str:
    """The log weight; a dash where rollouts carry none."""
    has_weights = by_name(run.config.method).has_likelihood_ratios
    return number(entry.log_weight if has_weights else None)


def robustness_text(value: float) -> str:
    """Robustness with as many decimals in every row, as far as that tells rows apart."""
    if 0.01 <= abs(value) < 1000.0:
        return f"{value:.3f}".replace("-", MINUS)
    return number(value)


_CELL = "padding:2px 4px;text-align:right;white-space:nowrap"
