"""Tables of the Why tab: misses by distance and what fewer would bring; the likeliest chains."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, cast

from pemviz.panel.palette import MISSED
from pemviz.panel.run_data import RunData
from pemviz.panel.svg import FAINT, GRID, nice_ticks, svg, text
from pemviz.panel.views.learning import is_number
from pemviz.panel.views.words import MINUS, grid, heading, number, percent, quiet, rows, table

SHOWN_CHAINS = 8
SMALLEST_SHOWN = 0.005
STRIP_WIDTH, STRIP_HEIGHT = 250, 16
STRIP_MARGIN_S = 0.1
DASH = "\N{EN DASH}"


def causes_part(run: RunData) -> str:
    """Both tables, as far as the engine offers them."""
    causes = table(run.document.get("causes"))
    misses = rows(causes.get("misses_by_distance"))
    sensitivity = rows(run.document.get("sensitivity"))
    chains = rows(causes.get("chains"))
    parts: list[str] = []
    if misses or sensitivity:
        parts += [
            heading("Misses by distance, and what fewer of them would bring"),
            band_table(misses, sensitivity, target=run.config.target),
            quiet(_band_note(run, causes)),
        ]
    if chains:
        dt_s = run.config.scenario.dt_s
        parts += [
            heading("Likeliest chains of misses"),
            chain_table(chains, dt_s=dt_s),
            quiet(_chain_note(chains)),
        ]
    return "".join(parts)


def band_table(
    misses: Sequence[Mapping[str, Any]],
    sensitivity: Sequence[Mapping[str, Any]],
    *,
    target: float | None,
) -> str:
    """One line for each band of the gap in which misses matter, and one for all together."""
    by_band, missed = _by_band(sensitivity), _by_band(misses)
    lines: list[list[str]] = []
    for low, high in {**missed, **by_band}:
        found, sensitive = missed.get((low, high), {}), by_band.get((low, high), {})
        if is_number(low) and is_number(high) and _matters(found, sensitive):
            lines.append(_band_line(f"{low:g} to {high:g}", found, sensitive, target))
    total = sum(float(m["misses"]) for m in misses if is_number(m.get("misses")))
    everywhere = {"misses": total, "share": 1.0} if misses else {}
    lines.append(_band_line("<b>all</b>", everywhere, by_band.get((None, None)), target))
    header = ["gap [m]", "misses in a violation", "of all misses", "sensitivity"]
    if target is not None:
        header.append(f"misses must fall to, for {number(target, 2)}")
    return grid(header, lines, name="Misses by distance")


def _by_band(
    found: Sequence[Mapping[str, Any]],
) -> dict[tuple[float | None, float | None], Mapping[str, Any]]:
    """By low and high end [m]; both ``None`` for all distances together."""
    ends = [(entry.get("low"), entry.get("high")) for entry in found]
    return {
        cast(tuple[float | None, float | None], band): entry
        for band, entry in zip(ends, found, strict=True)
        if all(end is None or is_number(end) for end in band)
    }


def _matters(missed: Mapping[str, Any], sensitive: Mapping[str, Any]) -> bool:
    found = (missed.get("misses"), sensitive.get("elasticity"))
    return any(is_number(value) and abs(cast(float, value)) >= SMALLEST_SHOWN for value in found)


def _band_line(
    name: str,
    missed: Mapping[str, Any],
    sensitive: Mapping[str, Any] | None,
    target: float | None,
) -> list[str]:
    known = sensitive or {}
    line = [
        name,
        decimals(missed.get("misses")),
        percent(missed.get("share")),
        decimals(known.get("elasticity")),
    ]
    if target is not None:
        line.append(_target_text(known))
    return line


def _target_text(sensitive: Mapping[str, Any]) -> str:
    factor = sensitive.get("target_factor")
    if not is_number(factor):
        return "not enough alone"
    if float(cast(float, factor)) >= 1.0:
        return "met already"
    guess = " (extrapolated)" if sensitive.get("warning") else ""
    return f"{number(100.0 * float(cast(float, factor)), 2)} %{guess}"


def _band_note(run: RunData, causes: Mapping[str, Any]) -> str:
    words = (
        "Sensitivity: one per cent fewer misses in a band bring about so many per cent fewer "
        "violations. Counted are misses at steps where the outcome matters; bands without any "
        "are left out."
    )
    repetition = causes.get("repetition")
    if run.config.repetitions > 1 and isinstance(repetition, int):
        words += f" From the final rollouts of repetition {repetition + 1}."
    return words


def chain_table(chains: Sequence[Mapping[str, Any]], *, dt_s: float) -> str:
    """One line for each chain: its share, its length, and a strip with a stroke at every miss."""
    shown = [chain for chain in chains[:SHOWN_CHAINS] if _steps(chain)]
    every = [step for chain in shown for step in _steps(chain)]
    if not every:
        return ""
    low_s = max(0.0, min(every) * dt_s - STRIP_MARGIN_S)
    high_s = (max(every) + 1) * dt_s + STRIP_MARGIN_S
    lines = [
        [
            percent(chain.get("share")),
            str(len(_steps(chain))),
            _strip(_steps(chain), dt_s=dt_s, low_s=low_s, high_s=high_s),
        ]
        for chain in shown
    ]
    lines.append(["", "", _axis(low_s, high_s)])
    header = ("of all violations", "misses", "missed at [s]")
    return grid(header, lines, name="Likeliest chains of misses")


def _steps(chain: Mapping[str, Any]) -> list[int]:
    steps: Any = chain.get("missed_steps")
    found = cast(list[Any], steps) if isinstance(steps, list | tuple) else []
    return [step for step in found if isinstance(step, int) and step >= 0]


def _strip(steps: Sequence[int], *, dt_s: float, low_s: float, high_s: float) -> str:
    scale = STRIP_WIDTH / (high_s - low_s)
    width = max(dt_s * scale - 0.8, 1.0)
    marks = "".join(
        f"<rect x='{(step * dt_s - low_s) * scale:.1f}' y='2' width='{width:.1f}'"
        f" height='{STRIP_HEIGHT - 4}' fill='{MISSED}'/>"
        for step in steps
    )
    times = ", ".join(f"{step * dt_s:.2f}" for step in steps)
    line = f"<path d='M0 {STRIP_HEIGHT / 2}H{STRIP_WIDTH}' stroke='{GRID}'/>"
    tip = f"<title>missed at {escape(times)} s</title>"
    return svg(f"<g>{tip}{line}{marks}</g>", width=STRIP_WIDTH, height=STRIP_HEIGHT, title="misses")


def _axis(low_s: float, high_s: float) -> str:
    scale = STRIP_WIDTH / (high_s - low_s)
    ticks = "".join(
        f"<path d='M{(tick - low_s) * scale:.1f} 0v4' stroke='{FAINT}'/>"
        + text(f"{tick:g}", (tick - low_s) * scale, 14, anchor="middle")
        for tick in nice_ticks(low_s, high_s, count=5)
        if 0.03 < (tick - low_s) / (high_s - low_s) < 0.97
    )
    body = f"<path d='M0 0.5H{STRIP_WIDTH}' stroke='{FAINT}'/>{ticks}"
    return svg(body, width=STRIP_WIDTH, height=STRIP_HEIGHT, title="time [s]")


def _chain_note(chains: Sequence[Mapping[str, Any]]) -> str:
    listed = [float(c["share"]) for c in chains[:SHOWN_CHAINS] if is_number(c.get("share"))]
    return (
        f"These {len(listed)} chains make up {percent(sum(listed))} of the estimated probability. "
        "Only misses at steps where the outcome matters are drawn."
    )


def decimals(value: Any) -> str:
    """A figure of ordinary size with two decimals, a dash if there is none."""
    if not is_number(value):
        return DASH
    return f"{value:.2f}".replace("-", MINUS)
