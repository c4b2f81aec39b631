"""What to measure next."""

import re
from collections.abc import Sequence

from pemviz.analysis.data_plan import DataPlan, RefitBand, SequencePlan
from pemviz.analysis.label_plan import BandPlan, LabelPlan
from pemviz.reports.document import Table
from pemviz.runs.answers import answers
from pemviz.runs.result import RunResult

PLAN_TITLE = "What to measure next"


def short_rows(result: RunResult) -> list[tuple[str, str]]:
    """What to collect and what it would bring, a line each, what decides first; empty if none."""
    plan = result.plan
    if plan is None:
        return []
    rows: list[tuple[str, str]] = []
    if plan.labels is not None:
        rows.append(_labels_row(plan, plan.labels, result=result))
    if plan.refits:
        rows.append(
            (_labels_text(plan.refits), f"the range over {result.pem.name}'s refits halves")
        )
    if plan.sequences is not None:
        found = answers(result)
        first = bool(found) and found[0].open.decided_by.kind == "memory"
        rows.insert(0 if first else len(rows), _sequences_row(plan.sequences))
    return rows


def plan_heading(plan: DataPlan) -> str:
    """The title, and what is to be labelled, in a line."""
    if plan.labels is None:
        return PLAN_TITLE
    kind = re.sub(r" \([^)]*\)", "", plan.labels.obstacle)
    return f"{PLAN_TITLE} (labels of {kind}; distances to its centre)"


def _labels_row(plan: DataPlan, labels: LabelPlan, *, result: RunResult) -> tuple[str, str]:
    """Labels by band and what they show; where they cannot do, what the detector has to reach."""
    halfway = ", on a logarithmic scale halfway to the answer" if plan.halves else ""
    better_at = [
        f"misses at most {band.required:.2g} at {z_text(band)}"
        for band in labels.bands
        if band.labels is None
    ]
    if better_at:
        collect = f"a better detector: one that {', '.join(better_at)}"
        return collect, f"labels can show {labels.target:.2g}{halfway}"
    shown = f"the data alone show under {labels.target:.2g}{halfway}"
    wanted = _labels_text(labels.bands)
    if not wanted:
        return "nothing: the labels at hand do", shown
    alone = result.memory is None or result.memory.is_independent
    granted = f"{result.pem.name} is right{' and misses are independent' * alone}"
    return wanted, f"{shown} ({labels.power:.0%} sure if {granted})"


def _labels_text(bands: Sequence[BandPlan | RefitBand]) -> str:
    """For example: label 102 more at 5 to 7 m, 1,290 at 7 to 13 m."""
    wanted = [f"{band.labels:,} more at {z_text(band)}" for band in bands if band.labels]
    return f"label {', '.join(wanted)}" if wanted else ""


def _sequences_row(plan: SequencePlan) -> tuple[str, str]:
    known = f"{plan.wanted:,} tracked sequences"
    percent = f"+- {100.0 * (plan.factor - 1.0):.0f} %"
    if plan.is_own:
        return (f"{known} (now {plan.sequences})", f"memory time of misses known to {percent}")
    return (known, f"memory time of misses known to {percent}, if like model {plan.example}'s")


def plan_sentences(result: RunResult) -> list[str]:
    """The plan in sentences; empty without one."""
    plan = result.plan
    if plan is None:
        return []
    sentences = [] if plan.reason is None else [f"No labels are planned: {plan.reason}."]
    if plan.labels is not None:
        sentences += _label_sentences(plan.labels, pem=result.pem.name, halves=plan.halves)
    sentences += [_refit_sentence(band, pem=result.pem.name) for band in plan.refits]
    if plan.sequences is not None:
        sentences.append(_sequence_sentence(plan.sequences))
    return sentences


def _label_sentences(labels: LabelPlan, *, pem: str, halves: bool) -> list[str]:
    chosen = (
        ", which lies halfway, in powers of ten, from what the labels at hand allow to the answer"
        if halves
        else ""
    )
    first = (
        f"To show a failure probability below {labels.target:.2g}{chosen}, by labels alone, the "
        f"cheapest way is to label, of {labels.obstacle}:"
    )
    last = (
        f"All bands' bounds hold together at {labels.confidence:.0%}; if the detector misses as "
        f"often as {pem} says, the samples together show the target with a probability of "
        f"{labels.power:.0%}: more misses in one band are made up for by fewer in another."
    )
    warning = [] if labels.warning is None else [f"Mind: {labels.warning}."]
    return [first, *(_band_sentence(band, pem=pem) for band in labels.bands), last, *warning]


def _band_sentence(band: BandPlan, *, pem: str) -> str:
    where = f"With z from {z_text(band)}"
    so_far = f"{band.missed} of {band.obstacles} missed so far" if band.obstacles else "none so far"
    required = f"P(missed) of at most {band.required:.2g}"
    if band.labels is None or band.most_missed is None:
        return (
            f"{where} ({so_far}) {required} is required and {pem} has {band.model:.2g}: no number "
            "of labels shows that, the detector has to become better first."
        )
    if band.labels == 0:
        return f"{where} the labels at hand do ({so_far}): {required} is required."
    return (
        f"{where} label {band.labels:,} more ({so_far}): if at most {band.most_missed:,} of them "
        f"are missed, {required} is shown ({pem} has {band.model:.2g}); {band.fewest_labels:,} do "
        "if none is missed."
    )


def _refit_sentence(band: RefitBand, *, pem: str) -> str:
    return (
        f"{band.contribution:.0%} of the variance over refits of {pem} comes from z from "
        f"{z_text(band)}, where their P(missed) differ by a factor of {band.spread:.2g}: "
        f"{band.labels:,} more labels there would halve that part of the range, in powers of ten."
    )


def _sequence_sentence(plan: SequencePlan) -> str:
    measured = f"{plan.tau_s:.2g} s ({plan.low_s:.2g} to {plan.high_s:.2g} s)"
    wanted = f"about {plan.wanted:,} such sequences would fix it to within a factor of"
    if plan.is_own:
        return (
            f"The memory time of {plan.example}, {measured}, rests on {plan.sequences} tracked "
            f"sequences; {wanted} {plan.factor:g}."
        )
    return (
        "Single frames tell nothing of how misses follow each other: label video. For "
        f"{plan.example}, {plan.sequences} tracked sequences give a memory time of {measured}; "
        f"{wanted} {plan.factor:g}."
    )


def plan_table(labels: LabelPlan) -> Table:
    """What is known and wanted of each band, near to far."""
    columns = (
        "z [m]",
        "missed so far",
        "model",
        "allowed",
        "required",
        "to label",
        "may be missed",
        "or, if none is",
    )
    rows = [
        (
            z_text(band, unit=""),
            f"{band.missed:,} of {band.obstacles:,}",
            f"{band.model:.2g}",
            f"{band.allowed:.2g}",
            f"{band.required:.2g}",
            "out of reach" if band.labels is None else f"{band.labels:,}",
            "-" if band.most_missed is None else f"{band.most_missed:,}",
            f"{band.fewest_labels:,}",
        )
        for band in labels.bands
    ]
    note = (
        "P(missed): the model's, the largest that the labels so far allow, the largest with which "
        "the target is met. To label: so many more, of which so many may be missed; fewer do if "
        "none is. z: from the camera to the obstacle's centre, in the braking scenario 2.5 m more "
        "than the gap. Each label has to be of another obstacle: frames of one resemble each other."
    )
    return Table(columns, tuple(rows), note=note, numbers=tuple(range(len(columns))))


def z_text(band: BandPlan | RefitBand, *, unit: str = " m") -> str:
    """The band's distances: 5 to 7 m."""
    if band.low_m is None and band.high_m is None:
        return "any distance"
    if band.low_m is None:
        return f"below {band.high_m:g}{unit}"
    if band.high_m is None:
        return f"beyond {band.low_m:g}{unit}"
    return f"{band.low_m:g} to {band.high_m:g}{unit}"
