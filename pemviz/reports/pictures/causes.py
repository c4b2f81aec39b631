"""Tables of causes: misses by distance and what fewer would bring; the likeliest chains."""

from collections.abc import Sequence
from html import escape

from pemviz.analysis.causes import BandMisses, Chain
from pemviz.analysis.explanation import Explanation
from pemviz.analysis.sensitivity import BandSensitivity
from pemviz.colors import MISSED
from pemviz.reports.causes_text import BURST_TITLE, burst_rows
from pemviz.reports.pictures.html import MINUS, clickable, grid, heading, number, percent, quiet
from pemviz.reports.pictures.svg import FAINT, GRID, nice_ticks, svg, text
from pemviz.runs.result import RunResult

SHOWN_CHAINS = 8
SMALLEST_SHOWN = 0.005
STRIP_WIDTH, STRIP_HEIGHT = 250, 16
STRIP_MARGIN_S = 0.1
CLICK_NOTE = " Click one to see the rollout that contributes most to it in the scene."
DASH = "\N{EN DASH}"
BURST_NOTE = (
    "The decisive burst of a violation has the most misses where the outcome matters. Figures are "
    "medians, in brackets what four of five violations have; probabilities are the error model's, "
    "geometric means."
)


def cause_sections(result: RunResult, *, target: str = "") -> list[str]:
    """Misses by distance, bursts and chains, each with its heading, as far as a run tells them.

    Args:
        result: The run's.
        target: Element id of the input that a click on a chain writes its place into; on a page
            without one, nothing can be clicked.
    """
    explanation = result.explanation
    if explanation is None:
        return []
    by_distance = (
        heading("Misses by distance, and what fewer of them would bring"),
        band_table(explanation, target=result.config.target),
        quiet(_band_note(result, explanation)),
    )
    sections = ["".join(by_distance), bursts_part(explanation, target=result.config.target)]
    if explanation.chains:
        dt_s = result.config.dt_s
        chains = (
            heading("Likeliest chains of misses"),
            chain_table(explanation.chains, dt_s=dt_s, target=target),
            quiet(_chain_note(explanation.chains) + (CLICK_NOTE if target else "")),
        )
        sections.append("".join(chains))
    return sections


def bursts_part(explanation: Explanation, *, target: float | None) -> str:
    """How misses hang together before a violation; empty if nothing is told of it."""
    rows = [tuple(map(escape, row)) for row in burst_rows(explanation, target=target)]
    if not rows:
        return ""
    table = grid(("", "in a violation"), rows, name=BURST_TITLE)
    return heading(BURST_TITLE) + table + quiet(BURST_NOTE)


def band_table(explanation: Explanation, *, target: float | None) -> str:
    """One line for each band of the gap in which misses matter, and one for all together."""
    everywhere, *bands = explanation.sensitivity
    lines: list[list[str]] = []
    for band, sensitivity in zip(explanation.misses_by_distance, bands, strict=True):
        if _matters(band, sensitivity):
            name = f"{band.low:g} to {band.high:g}"
            lines.append(_band_line(name, band.misses, band.share, sensitivity, target))
    misses = share = None
    if explanation.misses_by_distance:
        misses, share = sum(band.misses for band in explanation.misses_by_distance), 1.0
    lines.append(_band_line("<b>all</b>", misses, share, everywhere, target))
    header = ["gap [m]", "misses in a violation", "of all misses", "sensitivity"]
    if target is not None:
        header.append(f"misses must fall to, for {number(target, 2)}")
    return grid(header, lines, name="Misses by distance")


def _matters(band: BandMisses, sensitivity: BandSensitivity) -> bool:
    figures = (band.misses, sensitivity.elasticity)
    return any(value is not None and abs(value) >= SMALLEST_SHOWN for value in figures)


def _band_line(
    name: str,
    misses: float | None,
    share: float | None,
    sensitivity: BandSensitivity,
    target: float | None,
) -> list[str]:
    elasticity = decimals(sensitivity.elasticity)
    if sensitivity.elasticity is not None and sensitivity.std_error is not None:
        elasticity += f" \N{PLUS-MINUS SIGN} {sensitivity.std_error:.2f}"
    line = [name, decimals(misses), percent(share), elasticity]
    if target is not None:
        line.append(_target_text(sensitivity))
    return line


def _target_text(sensitivity: BandSensitivity) -> str:
    factor = sensitivity.target_factor
    if factor is None:
        return "not enough alone"
    if factor >= 1.0:
        return "met already"
    guess = " (extrapolated)" if sensitivity.warning else ""
    return f"{number(100.0 * factor, 2)} %{guess}"


def _band_note(result: RunResult, explanation: Explanation) -> str:
    words = (
        "Sensitivity: one per cent fewer misses in a band bring about so many per cent fewer "
        "violations. Counted are misses at steps where the outcome matters; bands without any "
        "are left out. \N{PLUS-MINUS SIGN}: one standard error."
    )
    if result.config.repetitions > 1:
        words += f" From the final rollouts of repetition {explanation.repetition + 1}."
    return words


def shown_chains(chains: Sequence[Chain]) -> list[Chain]:
    """Those of the table."""
    return [chain for chain in chains[:SHOWN_CHAINS] if chain.missed_steps]


def chain_table(chains: Sequence[Chain], *, dt_s: float, target: str = "") -> str:
    """One line for each chain: its share, its length, and a strip with a stroke at every miss."""
    shown = shown_chains(chains)
    every = [step for chain in shown for step in chain.missed_steps]
    if not every:
        return ""
    low_s = max(0.0, min(every) * dt_s - STRIP_MARGIN_S)
    high_s = (max(every) + 1) * dt_s + STRIP_MARGIN_S
    lines = [
        [
            percent(chain.share),
            str(len(chain.missed_steps)),
            _strip(chain.missed_steps, dt_s=dt_s, low_s=low_s, high_s=high_s),
        ]
        for chain in shown
    ]
    lines.append(["", "", _axis(low_s, high_s)])
    header = ("of all violations", "misses", "missed at [s]")
    places = range(1, len(shown) + 1)
    return grid(
        header,
        lines,
        name="Likeliest chains of misses",
        attributes=[clickable(place, target=target) for place in places] if target else [],
    )


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


def _chain_note(chains: Sequence[Chain]) -> str:
    listed = [chain.share for chain in chains[:SHOWN_CHAINS]]
    return (
        f"These {len(listed)} chains make up {percent(sum(listed))} of the estimated probability. "
        "Only misses at steps where the outcome matters are drawn."
    )


def decimals(value: float | None) -> str:
    """A figure of ordinary size with two decimals, a dash if there is none."""
    return DASH if value is None else f"{value:.2f}".replace("-", MINUS)
