"""What causes violations: misses by distance, bursts of them, the likeliest chains."""

from collections.abc import Iterator, Sequence
from itertools import groupby

from pemviz.analysis.causes import BandMisses, Bursts, Chain, Spread
from pemviz.analysis.explanation import Explanation, SlotErrors
from pemviz.analysis.sensitivity import BandSensitivity, MemorySensitivity
from pemviz.reports.document import Strip, Table
from pemviz.reports.numbers import share_text
from pemviz.runs.result import RunResult

SHOWN_MISSES = 0.005
SMALLEST_SHOWN = 0.005
"""Of an elasticity."""
BURST_TITLE = "Bursts before a violation: misses in one frame after the other"
BURST_COLUMNS = ("bursts", "in a violation")
BURST = "misses in a row"
"""What a burst is, where it is first spoken of."""
BURST_NOTE = (
    "The decisive burst of a violation has the most misses where the outcome matters. Figures are "
    "medians, in brackets what four of five violations have; probabilities are the error model's, "
    "geometric means."
)
SHOWN_CHAINS = 8
STRIP_MARGIN_S = 0.1
"""Before the first miss of a chain, and after the last."""
FEW = 1e-3
"""Smaller probabilities are written with an exponent."""


def causes_line(explanation: Explanation) -> str:
    """Where the misses of a violation lie, in one line; those at steps where outcomes matter.

    With slots: whose errors they are.
    """
    if explanation.slots:
        total = sum(slot.errors for slot in explanation.slots)
        of_slots = "; ".join(map(_of_slot, explanation.slots))
        return f"Errors that matter in a violation: {total:.1f} ({of_slots})"
    bands = [
        f"{band.misses:.1f} at {band.low:g} to {band.high:g} m"
        for band in explanation.misses_by_distance
        if band.misses > SHOWN_MISSES
    ]
    total = sum(band.misses for band in explanation.misses_by_distance)
    where = f" ({', '.join(bands)})" if bands else ""
    return f"Misses that matter in a violation: {total:.1f}{where}"


def _of_slot(slot: SlotErrors) -> str:
    word = "missed" if slot.nominal else "reported where nothing is"
    return f"{slot.name} {word} {slot.errors:.1f} times, 1 % less often: {_fewer(slot)}"


def burst_lines(explanation: Explanation) -> list[str]:
    """How misses hang together before a violation, and what shorter bursts would bring.

    A short line each; :func:`burst_rows` has the ranges too.
    """
    bursts, lines = explanation.bursts, list[str]()
    if bursts is not None:
        frames, at = bursts.frames.median, bursts.begins_gap_m
        begins = f"{bursts.begins_s.median:.2f} s" if at is None else f"{at.median:.1f} m"
        likely = bursts.start if bursts.again is None else bursts.whole
        lines.append(
            f"Bursts ({BURST}) in a violation: {bursts.count:.1f}; the decisive one: {frames:.0f} "
            f"frames ({frames * bursts.dt_s:.2f} s) from {begins} on, probability "
            f"{_probability(likely)}"
        )
    memory, everywhere = explanation.memory, explanation.sensitivity[0]
    if memory is not None:
        lines.append(
            f"A memory 1 % shorter would bring {_fewer(memory)}; 1 % fewer misses, the memory as "
            f"it is, {_fewer(everywhere)}"
        )
    return lines


def burst_rows(explanation: Explanation, *, target: float | None) -> list[tuple[str, str]]:
    """The same as a small table, with what meets a target; see :data:`BURST_COLUMNS`."""
    bursts, rows = explanation.bursts, list[tuple[str, str]]()
    if bursts is not None:
        rows += [
            ("how many", f"{bursts.count:.1f}, with {bursts.misses:.1f} misses in all"),
            ("the decisive one lasts", _length(bursts)),
            ("it begins", _begins(bursts)),
            ("how likely that is", _likely(bursts)),
        ]
    memory, everywhere = explanation.memory, explanation.sensitivity[0]
    if memory is None:
        return rows
    rows += [
        ("a memory 1 % shorter", _fewer(memory)),
        ("1 % fewer misses, the memory as it is", _fewer(everywhere)),
    ]
    if target is not None:
        rows.append((f"memory time for {target:.2g}", target_tau_text(memory)))
    return rows


def target_tau_text(memory: MemorySensitivity) -> str:
    """The memory time that meets the target, as a requirement."""
    if memory.target_tau_s is None:
        return "not enough alone"
    if memory.target_tau_s >= memory.tau_s:
        return "met already"
    guess = " (extrapolated)" if memory.warning else ""
    return f"{memory.target_tau_s:.2g} s instead of {memory.tau_s:g} s{guess}"


def _length(bursts: Bursts) -> str:
    frames = bursts.frames
    return (
        f"{frames.median * bursts.dt_s:.2f} s ({frames.median:.0f} frames; four of five "
        f"violations: {frames.low:.0f} to {frames.high:.0f})"
    )


def _begins(bursts: Bursts) -> str:
    at_s = f"{_ends(bursts.begins_s, 2)} s after the start"
    return at_s if bursts.begins_gap_m is None else f"at {_ends(bursts.begins_gap_m, 1)} m, {at_s}"


def _ends(spread: Spread, digits: int) -> str:
    return f"{spread.median:.{digits}f} ({spread.low:.{digits}f} to {spread.high:.{digits}f})"


def _likely(bursts: Bursts) -> str:
    started = f"starting it has a probability of {_probability(bursts.start)}"
    if bursts.again is None:
        return started
    return (
        f"{started}, each further miss {_probability(bursts.again)}, all these together "
        f"{_probability(bursts.whole)}"
    )


def _probability(value: float) -> str:
    return f"{value:.1e}" if value < FEW else f"{value:.2g}"


def elasticity_text(found: BandSensitivity | MemorySensitivity) -> str:
    """An elasticity with its standard error, or that this is not known; a dash without one."""
    if found.elasticity is None:
        return "-"
    error = " (error not known)" if found.std_error is None else f" +- {found.std_error:.2f}"
    return f"{round(found.elasticity, 2) + 0.0:.2f}{error}"  # no minus before a zero


def _fewer(found: BandSensitivity | MemorySensitivity | SlotErrors) -> str:
    """What one per cent less brings."""
    if found.elasticity is None:
        return "nobody knows what: a miss is certain somewhere"
    if abs(found.elasticity) < SMALLEST_SHOWN:
        return "hardly any fewer violations"
    error = "" if found.std_error is None else f" +- {found.std_error:.1g}"
    kind = "fewer" if found.elasticity >= 0.0 else "more"
    return f"{abs(found.elasticity):.2g}{error} % {kind} violations"


def band_columns(target: float | None) -> tuple[str, ...]:
    """What :func:`band_rows` give."""
    wanted = () if target is None else (f"misses must fall to, for {target:.2g}",)
    return ("gap [m]", "misses in a violation", "of all misses", "sensitivity", *wanted)


def band_rows(explanation: Explanation, *, target: float | None) -> list[tuple[str, ...]]:
    """Each band of the gap in which misses matter, and all together."""
    everywhere, *bands = explanation.sensitivity
    every = list(zip(explanation.misses_by_distance, bands, strict=True))
    total = sum(band.misses for band, _ in every)
    return [
        *(
            _band_row(f"{band.low:g} to {band.high:g}", band.misses, band.share, found, target)
            for band, found in every
            if _matters(band, found)
        ),
        _band_row("all", total, 1.0, everywhere, target),
    ]


def _matters(band: BandMisses, found: BandSensitivity) -> bool:
    figures = (band.misses, found.elasticity)
    return any(value is not None and abs(value) >= SMALLEST_SHOWN for value in figures)


def _band_row(
    name: str, misses: float, share: float, found: BandSensitivity, target: float | None
) -> tuple[str, ...]:
    row = (name, f"{misses:.2f}", share_text(share), elasticity_text(found))
    return row if target is None else (*row, _target_text(found))


def _target_text(found: BandSensitivity) -> str:
    if found.elasticity is None and found.warning:
        return found.warning
    if found.target_factor is None:
        return "not enough alone"
    if found.target_factor >= 1.0:
        return "met already"
    return f"{100.0 * found.target_factor:.2g} %{' (extrapolated)' if found.warning else ''}"


def band_note(result: RunResult) -> str:
    """What the table by distance counts."""
    words = (
        "Sensitivity: one per cent fewer misses in a band bring about so many per cent fewer "
        "violations, +- one standard error. Counted are misses at steps where the outcome "
        "matters; bands without any are left out."
    )
    if result.config.repetitions > 1 and result.explanation is not None:
        words += f" From the final rollouts of repetition {result.explanation.repetition + 1}."
    return words


def shown_chains(chains: Sequence[Chain]) -> list[Chain]:
    """Those of the table."""
    return [chain for chain in chains[:SHOWN_CHAINS] if chain.missed_steps]


def chain_table(chains: Sequence[Chain], *, dt_s: float) -> Table | None:
    """Share, number of misses and when they are, of the likeliest; ``None`` without a miss."""
    shown = shown_chains(chains)
    every = [step for chain in shown for step in chain.missed_steps]
    if not every:
        return None
    low_s = max(0.0, min(every) * dt_s - STRIP_MARGIN_S)
    end_s = (max(every) + 1) * dt_s + STRIP_MARGIN_S
    long_s = end_s - low_s
    rows: list[tuple[str | Strip, ...]] = []
    for chain in shown:
        bursts = list(_in_a_row(chain.missed_steps))
        times = (f"{first * dt_s:.2f}" + f" to {last * dt_s:.2f}" * (last > first)
                 for first, last in bursts)  # fmt: skip
        spans = tuple(
            ((first * dt_s - low_s) / long_s, ((last + 1) * dt_s - low_s) / long_s)
            for first, last in bursts
        )
        count = str(len(chain.missed_steps))
        rows.append((share_text(chain.share), count, Strip(", ".join(times), spans)))
    listed = share_text(sum(chain.share for chain in chains[:SHOWN_CHAINS]))
    return Table(
        ("of all violations", "misses", f"missed at [s], from {low_s:.1f} to {end_s:.1f}"),
        tuple(rows),
        name="Likeliest chains of misses",
        note=f"The chains shown make up {listed} of the estimated probability. Only misses at "
        "steps where the outcome matters are told.",
        numbers=(0, 1),
        places=tuple(range(1, len(rows) + 1)),
        target="chain",
    )


def _in_a_row(steps: Sequence[int]) -> Iterator[tuple[int, int]]:
    """First and last of each unbroken run of steps."""
    ascending = enumerate(sorted(set(steps)))
    for _, run in groupby(ascending, key=lambda place: place[1] - place[0]):
        members = [step for _, step in run]
        yield members[0], members[-1]
