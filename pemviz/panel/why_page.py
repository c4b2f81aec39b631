"""The Why page: which misses cause violations, and how far to trust the number."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.analysis.causes import contributions
from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.charts.chart import Axis, Bars, Line, PlaneChart
from pemviz.colors import BLACK, VERMILLION
from pemviz.panel.pieces import cells, drawn, quiet
from pemviz.panel.ranking import log_contributions
from pemviz.panel.rollout_tables import final_violations
from pemviz.panel.run_data import RunData, detection_probability
from pemviz.reports.document import Block, Figure, Section, Table
from pemviz.reports.html import blocks_html, heading, sections_html
from pemviz.reports.run_document import TRUST, WHY, run_document
from pemviz.runs.drawn_rollout import faultless, slots_of
from pemviz.simulators.slots import Slot

BAND_M = 1.0
MOST_BANDS = 250
MOST_EXPLAINED = 20_000


def why(run: RunData) -> str:
    """The whole page; chains and rollouts in the plane of starts can be clicked."""
    if run.running:
        return quiet("Explained when the run under way is done.")
    return run.memo.get("why", lambda: _why(run))


def _why(run: RunData) -> str:
    document = run_document(run.result)
    sections = document.choose((*WHY, "plan", "warnings", *TRUST[:2], "memory"))
    return cells(
        *_misses(run),
        *(part for section in sections for part in section_cells(section)),
        sections_html(document.choose(("assumptions", "extrapolation")), live=True),
    )


def section_cells(section: Section) -> list[str]:
    """A section in full as pieces that may stand beside each other: a table or chart in each."""
    pieces: list[list[Block]] = [[]]
    for block in section.full:
        if isinstance(block, Table | Figure) and any(
            isinstance(one, Table | Figure) for one in pieces[-1]
        ):
            pieces.append([])
        pieces[-1].append(block)
    first, *others = (blocks_html(piece, live=True) for piece in pieces)
    return [heading(section.title) + first, *others]


@dataclass(frozen=True, eq=False)
class Failures:
    """The violating rollouts that explain the answer.

    Attributes:
        gap_m: ``[F, T-1]`` at the states where perception acted; ``None`` without a gap.
        missed: ``[F, T-1]``; with several slots, whether perception errs about any of them.
        pem_miss: ``[F, T-1]`` probability of that under the error model.
        weight: ``[F]`` importance weights, summing to 1.
        violations: How many violations these stand for, themselves included.
    """

    gap_m: FloatArray | None
    missed: BoolArray
    pem_miss: FloatArray
    weight: FloatArray
    violations: int


def failures_of(run: RunData) -> Failures | None:
    """Violations of the final stages, or of all stages if those have none."""
    if not run.parts:
        return None
    rollouts = run.rollouts
    chosen = final_violations(rollouts, stages=run.result.stages)
    if not np.any(chosen):
        chosen = np.asarray(rollouts["violated"], dtype=np.bool_)
    if not np.any(chosen):
        return None
    weight = contributions(log_contributions(run), violated=chosen)[chosen]
    places, weight = standing_for_all(weight, most=MOST_EXPLAINED)
    rows = np.flatnonzero(chosen)[places].astype(np.int64)
    gap_m = ["gap_m"] if run.own is None else []
    table = run.steps(["detected", "log_p", *gap_m], rows)
    detected = np.asarray(table["detected"], dtype=np.bool_)
    log_p = np.asarray(table["log_p"], dtype=np.float64)
    missed, pem_miss = ~detected, detection_probability(log_p, ~detected)
    if run.own is not None:
        slots = slots_of(run.own)
        missed, pem_miss = ~faultless(detected, slots=slots), _any_error(pem_miss, slots=slots)
    return Failures(
        gap_m=np.asarray(table["gap_m"][:, :-1], dtype=np.float64) if gap_m else None,
        missed=missed,
        pem_miss=pem_miss,
        weight=weight,
        violations=int(np.count_nonzero(chosen)),
    )


def standing_for_all(weight: FloatArray, *, most: int) -> tuple[IntArray, FloatArray]:
    """Places ``[M]`` of at most ``most`` of ``[N]`` weights, and weights ``[M]`` of the same sum.

    The heavier half is of the largest weights. Of the others, in the order of their weights, each
    chosen one stands for as many neighbours as any, and has the weight of them all.
    """
    if weight.size <= most:
        return np.arange(weight.size), weight
    order = np.argsort(-weight, kind="stable")
    heavy, rest = order[: most // 2], order[most // 2 :]
    edges = np.linspace(0, rest.size, most - heavy.size + 1).round().astype(np.int64)
    standing = weight.copy()
    middle = rest[(edges[:-1] + edges[1:]) // 2]
    standing[middle] = np.add.reduceat(weight[rest], edges[:-1])
    places = np.sort(np.concatenate([heavy, middle]))
    return places, standing[places]


def _any_error(missed: FloatArray, *, slots: Sequence[Slot]) -> FloatArray:
    """Probability that perception errs about any slot, from those of 'missed' of each."""
    nominal = np.array([slot.nominal for slot in slots] or [True], dtype=np.bool_)
    if len(slots) <= 1:
        return missed if nominal[0] else 1.0 - missed
    return 1.0 - np.prod(1.0 - np.where(nominal, missed, 1.0 - missed), axis=-1)


def _misses(run: RunData) -> list[str]:
    title = heading("Misses that cause violations")
    failures = failures_of(run)
    if failures is None:
        words = (
            "No rollout of this run violates: there is nothing to explain. Plain simulation "
            "hardly ever finds a violation; choose another method."
        )
        return [title + quiet(words)]
    memory = run.result.memory
    alone = memory is None or memory.is_independent
    given = "" if alone else ", given the outcomes before"
    note = (
        f"Share of steps missed in violations, weighted by how likely each is under {run.law_words}"
    )
    observed = run.result.is_of_detector_itself  # and no error model says how often it misses
    note += "." if observed else f", and what the error model itself says{given}."
    if failures.missed.shape[0] < failures.violations:
        note += (
            f" From {failures.missed.shape[0]:,} of {failures.violations:,} violations: the half "
            "of these that contribute most, and of the others an even choice, each of which "
            "stands for its neighbours in weight."
        )
    dt_s = run.simulator.dt_s
    share, expected = (
        np.sum(failures.weight[:, None] * values, axis=0)
        for values in (failures.missed, failures.pem_miss)
    )
    edges_s = np.arange(share.size + 1) * dt_s
    beside = None if observed else expected
    by_time = drawn(share_chart("time", "time [s]", edges_s, share, beside)) + quiet(note)
    words = title + quiet(_miss_sentence(run, failures))
    if failures.gap_m is None:
        return [words + by_time]
    edges, share, expected = by_distance(failures, failures.gap_m)
    tips = [
        f"{edges[i]:g} to {edges[i + 1]:g} m: {100 * share[i]:.0f} % missed"
        + ("" if observed else f", error model {100 * expected[i]:.2g} %")
        for i in range(share.size)
    ]
    beside = None if observed else expected
    by_gap = share_chart("distance", "gap [m]", edges, share, beside, tips=tips)
    return [words + drawn(by_gap), by_time]


def share_chart(
    by: str, label: str, edges: FloatArray, missed: FloatArray, expected: FloatArray | None,
    *, tips: Sequence[str] = (),
) -> PlaneChart:  # fmt: skip
    """Shares ``[B]`` of steps missed, and the error model's if any, between edges ``[B+1]``."""
    middle = (edges[:-1] + edges[1:]) / 2
    model = () if expected is None else (Line(middle, 100.0 * expected, BLACK, "error model"),)
    return PlaneChart(
        title=f"Missed in violations, by {by}",
        x=Axis(0.0, float(edges[-1]), label),
        y=Axis(0.0, 100.0, "steps missed [%]", ticks=(0.0, 50.0, 100.0)),
        marks=(
            Bars(edges, 100.0 * missed, VERMILLION, "in violations", tips=tuple(tips)),
            *model,
        ),
        height=200,
    )


def _miss_sentence(run: RunData, failures: Failures) -> str:
    """The chain of misses in words: where perception decides, if that is known."""
    count = float(np.sum(failures.weight * np.count_nonzero(failures.missed, axis=1)))
    where, explanation = "", run.result.explanation
    if explanation is not None and explanation.misses_by_distance:  # the total of the table
        count = sum(band.misses for band in explanation.misses_by_distance)
        where = " where perception decides"
    longest = float(np.sum(failures.weight * longest_runs(failures.missed)))
    words = (
        f"A violation takes {count:.1f} misses{where} on average, the longest unbroken chain being "
        f"{longest:.1f} steps ({longest * run.simulator.dt_s:.2f} s)."
    )
    if failures.gap_m is None:
        return words
    edges, share, _ = by_distance(failures, failures.gap_m)
    heavy = np.flatnonzero(np.nan_to_num(share) >= 0.5)
    if heavy.size:
        words += (
            f" Most steps between {edges[heavy[0]]:g} and {edges[heavy[-1] + 1]:g} m are missed."
        )
    return words


def longest_runs(missed: BoolArray) -> FloatArray:
    """The longest unbroken chain of misses ``[F]`` in each rollout."""
    longest = np.zeros(missed.shape[0])
    current = np.zeros(missed.shape[0])
    for step in range(missed.shape[1]):
        current = np.where(missed[:, step], current + 1, 0.0)
        longest = np.maximum(longest, current)
    return longest


def by_distance(failures: Failures, gap_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Edges ``[B+1]`` of gap bands, weighted share missed and the error model's ``[B]``."""
    high = max(BAND_M, float(np.ceil(np.max(gap_m))))
    band_m = BAND_M * max(1.0, float(np.ceil(high / (MOST_BANDS * BAND_M))))
    edges = np.arange(0.0, high + band_m / 2, band_m)
    weight = np.broadcast_to(failures.weight[:, None], gap_m.shape)
    inside = gap_m >= 0.0
    index = np.minimum((gap_m[inside] / band_m).astype(np.int64), edges.size - 2)

    def share(values: FloatArray) -> FloatArray:
        size = edges.size - 1
        total = np.bincount(index, weights=weight[inside], minlength=size)
        part = np.bincount(index, weights=(weight * values)[inside], minlength=size)
        return np.divide(part, total, out=np.full(size, np.nan), where=total > 0.0)

    return edges, share(failures.missed.astype(np.float64)), share(failures.pem_miss)
