"""The ranking as a table whose rows can be clicked."""

from html import escape

from pemviz.analysis.causes import CARRIED
from pemviz.colors import MISSED
from pemviz.panel.ranking import RankedRow, Ranking, row
from pemviz.panel.run_data import RunData
from pemviz.panel.views.elements import MINUS, block, cells, clickable, number, percent, quiet
from pemviz.sampling.registry import by_name

PAGE_ROWS = 12
LONG_NAMES = 18
SCENE = (
    "a ball over a car says what perception reports of it: small and blue detected, large and "
    "orange missed, grey nothing to report; beside the road stands a row for each obstacle, flat "
    "blue marks where the ego detected it, upright crosses where it erred. White lines: where "
    "the controller tracks a car, with an ellipse of two standard deviations where it knows any. "
    "From contact on the cars are grey."
)
VIOLATED = f"<b style='color:{MISSED}'>\N{MULTIPLICATION X} yes</b>"


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
    header = (
        "rank", f"robustness{unit}", "breaks" if run.config.rules else "violated",
        "of the answer", "log weight [nats]", "misses", "stage",
    )  # fmt: skip
    head = "".join(f"<th style='{_HEAD}'>{h}</th>" for h in header)
    lines: list[str] = []
    for place in range(start, min(start + PAGE_ROWS, count)):
        entry = row(run, ranking, place)
        values = (
            str(entry.rank), robustness_text(entry.robustness), _verdict(run, entry),
            percent(entry.share) if entry.share else "", weight_text(run, entry),
            str(entry.misses), str(entry.stage),
        )  # fmt: skip
        mark = "background:#dbeafe;font-weight:600;" if place == selected else ""
        selection = f" aria-selected='{'true' if place == selected else 'false'}'"
        lines.append(
            f"<tr data-rank='{entry.rank}' {clickable(entry.rank, target=target)}{selection}"
            f" style='border-top:1px solid #e4e7eb;cursor:pointer;{mark}'>"
            f"{cells(values, style=_CELL)}</tr>"
        )
    shown = (
        f"Ranks {start + 1} to {start + len(lines)} of {count:,} {ranked_text(ranking)}. "
        "Click a row, or press the up and down arrow keys; type a rank to jump. In the scene, "
        f"{SCENE}"
    )
    if run.kept < run.simulated:
        shown += (
            f" Of {run.simulated:,} rollouts {run.kept:,} are kept here: those that contribute "
            f"most to the answer, and the least robust under {run.config.metric}."
        )
    return block(
        f"<table aria-label='Ranking' style='border-collapse:collapse;width:100%;"
        f"font-size:11.5px;font-variant-numeric:tabular-nums'><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table>{quiet(shown)}"
    )


def _verdict(run: RunData, entry: RankedRow) -> str:
    """Whether a rollout violates; where there are rules, which of them it breaks."""
    if not run.config.rules:
        return VIOLATED if entry.violated else "no"
    names = escape(", ".join(entry.broken))
    if len(names) > LONG_NAMES:  # which they are is told below, of the rollout shown
        count = f"{len(entry.broken)} of {len(run.config.rules)}"
        names = f"<span title='{names}'>{count} rules</span>"
    return f"<b style='color:{MISSED}'>\N{MULTIPLICATION X}</b> {names}" if names else "none"


def ranked_text(ranking: Ranking) -> str:
    """Which rollouts are ranked, and how."""
    which = "rollouts"
    if ranking.among == "carrying":
        which = f"rollouts that make up {100 * CARRIED:g} % of the answer"
    under = ranking.metric
    if ranking.rule is not None:
        which += f" to rule {escape(ranking.rule)}" if ranking.among == "carrying" else ""
        under += f" in rule {escape(ranking.rule)}"
    how = f"the least robust under {under} first"
    if ranking.by_share:
        how = f"the largest contribution first, then the least robust under {under}"
    return f"{which}, {how}"


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
_HEAD = "padding:2px 4px;text-align:right;vertical-align:bottom;color:#52606d;font-weight:500"
