"""What violations are like: misses by distance, bursts of them, the likeliest chains, starts."""

from collections.abc import Sequence
from itertools import groupby

from pemviz.analysis.causes import Bursts, Chain, Spread
from pemviz.analysis.explanation import Explanation, SlotErrors
from pemviz.analysis.sensitivity import BandSensitivity, MemorySensitivity
from pemviz.analysis.starts import FEWEST, FEWEST_OF_MAP, DangerousStarts, StartValue
from pemviz.charts.chart import with_unit
from pemviz.reports.document import Strip, Table
from pemviz.reports.estimate_words import end_text, range_text, share_text
from pemviz.runs.result import RunResult

SMALLEST_SHOWN = 0.005
"""Of misses in a violation, and of an elasticity."""
SHOWN_CHAINS = 8
STRIP_MARGIN_S = 0.1
"""Before the first miss of a chain, and after the last."""
FEW = 1e-3
CERTAINLY = 1.0 - 1e-12
"""Smaller probabilities are written with an exponent."""
START_DIGITS = 3
SHIFTED_STARTS = 2
"""So many start values are named in a sentence."""


def causes_line(explanation: Explanation) -> str:
    """Where the misses of a violation lie, in one line; those at steps where outcomes matter.

    With slots: whose errors they are.
    """
    if explanation.slots:
        total = sum(slot.errors for slot in explanation.slots)
        of_slots = "; ".join(
            f"{slot.name} {'missed' if slot.nominal else 'reported where nothing is'} "
            f"{slot.errors:.1f} times, 1 % less often: {_fewer(slot)}"
            for slot in explanation.slots
        )
        return f"Errors that matter in a violation: {total:.1f} ({of_slots})"
    bands = [
        f"{band.misses:.1f} at {band.low:g} to {band.high:g} m"
        for band in explanation.misses_by_distance
        if band.misses > SMALLEST_SHOWN
    ]
    total = sum(explanation.miss_probability_by_step)  # where there is no gap, there are no bands
    where = f" ({', '.join(bands)})" if bands else ""
    return f"Misses that matter in a violation: {total:.1f}{where}"


def burst_lines(explanation: Explanation) -> list[str]:
    """How misses hang together before a violation, and what shorter bursts would bring.

    A short line each; :func:`burst_table` has the ranges too.
    """
    bursts, lines = explanation.bursts, list[str]()
    if bursts is not None:
        frames, at = bursts.frames.median, bursts.begins_gap_m
        unit = "frame" if round(frames) == 1 else "frames"
        begins = f"{bursts.begins_s.median:.2f} s" if at is None else f"{at.median:.1f} m"
        likely = _whole(bursts)
        chance = f", which has the probability {_probability(likely)} by itself"
        lines.append(
            f"Bursts (misses in a row) in a violation: {bursts.count:.1f}; the decisive one: "
            f"{frames:.0f} {unit} ({frames * bursts.dt_s:.2f} s) from {begins} on"
            f"{'' if likely > CERTAINLY else chance}"
        )
    memory, everywhere = explanation.memory, explanation.sensitivity[0]
    if memory is not None:
        lines.append(
            f"A memory 1 % shorter would bring {_fewer(memory)}; 1 % fewer misses, the memory as "
            f"it is, {_fewer(everywhere)}"
        )
    return lines


def burst_table(explanation: Explanation, *, target: float | None) -> Table | None:
    """The same with ranges, and with what meets a target; ``None`` where nothing is known."""
    bursts, rows = explanation.bursts, list[tuple[str, str]]()
    if bursts is not None:
        frames = bursts.frames
        lasts = (
            f"{frames.median * bursts.dt_s:.2f} s ({frames.median:.0f} frames; four of five "
            f"violations: {frames.low:.0f} to {frames.high:.0f})"
        )
        begins = f"{_spread(bursts.begins_s, 2)} s after the start"
        if bursts.begins_gap_m is not None:
            begins = f"at {_spread(bursts.begins_gap_m, 1)} m, {begins}"
        rows += [
            ("how many", f"{bursts.count:.1f}, with {bursts.misses:.1f} misses in all"),
            ("the decisive one lasts", lasts),
            ("it begins", begins),
            ("how likely that is", _likely(bursts)),
        ]
    memory, everywhere = explanation.memory, explanation.sensitivity[0]
    if memory is not None:
        rows += [
            ("a memory 1 % shorter", _fewer(memory)),
            ("1 % fewer misses, the memory as it is", _fewer(everywhere)),
        ]
        if target is not None:
            rows.append((f"memory time for {target:.2g}", _target_tau(memory)))
    return (
        Table(
            ("bursts", "in a violation"),
            tuple(rows),
            name="Bursts before a violation: misses in one frame after the other",
            note="The decisive burst of a violation has the most misses where the outcome matters. "
            "Figures are medians, in brackets what four of five violations have; probabilities are "
            "the error model's, geometric means.",
        )
        if rows
        else None
    )


def _target_tau(memory: MemorySensitivity) -> str:
    if memory.target_tau_s is None:
        return "not enough alone"
    if memory.target_tau_s >= memory.tau_s:
        return "met already"
    guess = " (extrapolated)" if memory.warning else ""
    return f"{memory.target_tau_s:.2g} s instead of {memory.tau_s:.3g} s{guess}"


def _spread(spread: Spread, digits: int) -> str:
    return f"{spread.median:.{digits}f} ({spread.low:.{digits}f} to {spread.high:.{digits}f})"


def _likely(bursts: Bursts) -> str:
    if bursts.start > CERTAINLY:  # observed, not sampled
        return "not known of observed outcomes"
    started = f"starting it has a probability of {_probability(bursts.start)}"
    if bursts.again is None:
        return started
    return (
        f"{started}, each further miss {_probability(bursts.again)}, the whole burst "
        f"{_probability(_whole(bursts))}"
    )


def _whole(bursts: Bursts) -> float:
    """Of the decisive burst, its first miss too."""
    return bursts.start if bursts.again is None else bursts.start * bursts.whole


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


def band_table(result: RunResult, explanation: Explanation) -> Table | None:
    """Each band of the gap in which misses matter, and all together; ``None`` without bands."""
    bands, target = explanation.misses_by_distance, result.config.target
    if not bands:
        return None
    everywhere, *by_band = explanation.sensitivity
    named = [
        (f"{band.low:g} to {band.high:g}", band.misses, band.share, found)
        for band, found in zip(bands, by_band, strict=True)
        if max(abs(band.misses), abs(found.elasticity or 0.0)) >= SMALLEST_SHOWN
    ]
    named.append(("all", sum(band.misses for band in bands), 1.0, everywhere))
    rows = [
        (name, f"{misses:.2f}", share_text(share), elasticity_text(found))
        + (() if target is None else (_target_text(found),))
        for name, misses, share, found in named
    ]
    wanted = () if target is None else (f"misses must fall to, for {target:.2g}",)
    note = (
        "Sensitivity: one per cent fewer misses in a band bring about so many per cent fewer "
        "violations, +- one standard error. Counted are misses at steps where the outcome "
        "matters; bands without any are left out."
    )
    if result.config.repetitions > 1:
        note += f" From the final rollouts of repetition {explanation.repetition + 1}."
    return Table(
        ("gap [m]", "misses in a violation", "of all misses", "sensitivity", *wanted),
        tuple(rows),
        name="Misses by distance, and what fewer of them would bring",
        note=note,
        numbers=(1, 2, 3),
    )


def _target_text(found: BandSensitivity) -> str:
    if found.elasticity is None and found.warning:
        return found.warning
    if found.target_factor is None:
        return "not enough alone"
    if found.target_factor >= 1.0:
        return "met already"
    return f"{100.0 * found.target_factor:.2g} %{' (extrapolated)' if found.warning else ''}"


def shown_chains(chains: Sequence[Chain]) -> list[Chain]:
    """Those of the table."""
    return [chain for chain in chains[:SHOWN_CHAINS] if chain.missed_steps]


def chain_table(chains: Sequence[Chain], *, dt_s: float) -> Table | None:
    """Share, number of misses and when they are, of the likeliest; ``None`` without a miss."""
    shown = shown_chains(chains)
    if not shown:
        return None
    every = [step for chain in shown for step in chain.missed_steps]
    low_s = max(0.0, min(every) * dt_s - STRIP_MARGIN_S)
    end_s = (max(every) + 1) * dt_s + STRIP_MARGIN_S
    long_s = end_s - low_s
    rows: list[tuple[str | Strip, ...]] = []
    for chain in shown:
        ascending = enumerate(sorted(set(chain.missed_steps)))
        in_a_row = groupby(ascending, key=lambda place: place[1] - place[0])
        runs = [[step for _, step in run] for _, run in in_a_row]
        times = (f"{run[0] * dt_s:.2f}" + f" to {run[-1] * dt_s:.2f}" * (len(run) > 1)
                 for run in runs)  # fmt: skip
        spans = tuple(
            ((run[0] * dt_s - low_s) / long_s, ((run[-1] + 1) * dt_s - low_s) / long_s)
            for run in runs
        )
        count = str(len(chain.missed_steps))
        rows.append((share_text(chain.share), count, Strip(", ".join(times), spans)))
    listed = share_text(sum(chain.share for chain in chains[:SHOWN_CHAINS]))
    return Table(
        ("of all violations", "misses", f"missed at [s], from {low_s:.1f} to {end_s:.1f}"),
        tuple(rows),
        name="Likeliest chains of misses",
        note=f"The chains shown make up {listed} of the estimated probability. Only misses at "
        "steps where the outcome matters are listed.",
        numbers=(0, 1),
        places=tuple(range(1, len(rows) + 1)),
        target="chain",
    )


def starts_line(found: DangerousStarts) -> str:
    """Where violations start and all starts do not, in a sentence."""
    if not all(one.violations for one in found.values):
        return (
            f"Which starts are dangerous is not known from {found.effective:.2g} effective "
            f"violations; {FEWEST:g} are needed"
        )
    shifted = found.shifted()[:SHIFTED_STARTS]
    if not shifted:
        return f"Violations start as all do, as far as {found.effective:.2g} effective ones show"
    return f"Violations start with {'; '.join(map(_against, shifted))}"


def _against(one: StartValue) -> str:
    """One value of violations against that of all starts."""
    low, middle, high = (end_text(q.value, digits=START_DIGITS) for q in one.violations)
    every_low, every, every_high = (end_text(v, digits=START_DIGITS) for v in one.all_starts)
    return (
        f"{one.name.replace('_', ' ')} {f'{middle} {one.unit}'.strip()} (80 % from {low} to "
        f"{high}), all with {f'{every} {one.unit}'.strip()} ({every_low} to {every_high})"
    )


def starts_table(found: DangerousStarts) -> Table:
    """Each start value of violations beside that of all starts; dashes where nothing is told."""
    columns = (
        "start value",
        "all: median",
        "80 % of all",
        "violations: median",
        "its 95 % interval",
        "80 % of violations",
    )
    rows: list[tuple[str, ...]] = []
    for one in found.values:
        name = with_unit(one.name.replace("_", " "), one.unit)
        low, every, high = one.all_starts
        own = ("-", "-", "-")
        if one.violations:
            least, middle, most = one.violations
            own = (
                end_text(middle.value, digits=START_DIGITS),
                range_text(middle.low, middle.high, digits=START_DIGITS),
                range_text(least.value, most.value, digits=START_DIGITS),
            )
        of_all = end_text(every, digits=START_DIGITS), range_text(low, high, digits=START_DIGITS)
        rows.append((name, *of_all, *own))
    whose = "" if found.rule is None else f" of rule {found.rule}"
    title = (
        f"{found.violations:,} violations{whose}, as good as {found.effective:.3g} equally likely "
        "ones with different starts"
    )
    return Table(columns, tuple(rows), name=title)


def map_words(found: DangerousStarts) -> str:
    """What the picture of the plane shows, and how far it can be trusted."""
    plane = found.plane
    if plane is None:
        return f"The plane of two start values takes {FEWEST_OF_MAP:g} effective violations."
    units = {one.name: one.unit for one in found.values}
    reach = " and ".join(
        f"{end_text(width)} {units[name]}".strip()
        for width, name in ((plane.across_reach, plane.across), (plane.up_reach, plane.up))
    )
    average = end_text(10.0**found.log10_probability)
    return (
        f"P(violation) for encounters that start there, {average} on average over all starts. "
        f"Averaged over starts within {reach} of it, the nearest most, and shown only where "
        f"{FEWEST:g} effective violations lie there, so that its standard error is below a third; "
        "grey: not known, and rarer as a rule. The box holds 80 % of all starts each way."
    )
