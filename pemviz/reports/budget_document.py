"""A risk budget as a document: is it met, by which hazards, what decides, what to do next."""

import math
from collections.abc import Iterator
from typing import Any

from pemviz.analysis.risk import FactorEffect, Interval, Risk, hours_needed
from pemviz.analysis.risk_factors import CurveHarm, Draws, FactorKind
from pemviz.charts.characters import characters
from pemviz.charts.chart import SOLID, IntervalChart, Row, Rule
from pemviz.colors import BLUE, GREY, VERMILLION
from pemviz.config.risk_budget import Hazard
from pemviz.reports import document as doc
from pemviz.reports.document import Block, Bullets, Caution, Document, Paragraph, Section, Table
from pemviz.reports.estimate_words import digits_of, end_text, range_text
from pemviz.reports.plan_words import short_rows
from pemviz.runs.risk_budget import JudgedBudget, JudgedHazard, Outcome

MARKS: dict[Outcome, doc.Mark] = {"met": "yes", "not met": "no", "not known": "open"}
FACTORS: dict[FactorKind, str] = {
    "encounters": "encounters an hour",
    "violation": "P(violation | encounter)",
    "harm": "P(harm | violation)",
}
HARM, VIOLATIONS = "harm an hour", "violations an hour"
MOST_EFFECTS = 3
"""In brief."""
LEAST_DRAWN = 1e-4
"""Of what is accepted."""
METHOD = (
    "Harm an hour is the sum over hazards of encounters an hour x P(violation | encounter) x "
    "P(harm | violation). Intervals are 95 % ones, by 100,000 stratified draws of all factors "
    "(Latin hypercube sampling): counts by the two distributions of their exact interval (Poisson: "
    "Garwood 1936; binomial: Clopper and Pearson 1934), stated intervals log-normal to either side "
    "of their median, a curve's coefficients jointly normal. A factor that hazards share is drawn "
    "once; all others as independent.",
    "P(violation) is open as far as the range to act on of the run's first screen: where it is not "
    "the sampling that reaches farthest but refits, other model classes, the data or a memory of "
    "misses, its end counts as a fixed number, since these are ranges and no distributions. The "
    "upper end is then one for the worst of them, the lower end for the best.",
    "Met: the upper end is at most what is accepted. Not met: it is higher. Not known: "
    "P(violation) of a hazard has no interval that holds, and what is known does not decide.",
)


def budget_document(judged: JudgedBudget) -> Document:
    """All that is said of a budget."""
    sections = (_verdict(judged), _table(judged), _decides(judged), _next(judged), _method(judged))
    return Document(judged.budget.name, tuple(one for one in sections if one is not None))


def verdict_sentence(judged: JudgedBudget) -> str:
    """Whether it is met, and by how much."""
    accepted, outcome = judged.budget.accepted_harm_per_hour, judged.outcome
    allowed = f"{end_text(accepted)} an hour are accepted"
    if outcome == "not known":
        open_ones = [one.hazard.name for one in judged.hazards if one.factors is None]
        return f"not known: nothing bounds {', '.join(open_ones)}; {allowed}"
    assert judged.risk is not None  # noqa: S101  one is known, or it would not be decided
    harm = judged.risk.harm_per_hour
    times = harm.high / accepted
    much = f"{_ratio(times)} times" if times > 1.0 else f"{times:.2g} of"
    also = (
        " by the hazards that are known" if any(h.factors is None for h in judged.hazards) else ""
    )
    least = f", at least {end_text(harm.low)}" if harm.low > accepted else ""
    return (
        f"{outcome}: harm{also} at most {end_text(harm.high)}{least} an hour, {much} what is "
        f"accepted, {end_text(accepted)}"
    )


def _ratio(value: float) -> str:
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 9.95 else f"{value:.1f}"


def budget_chart(judged: JudgedBudget) -> IntervalChart | None:
    """Harm an hour of each hazard and of all, and what is accepted; ``None`` if none is known."""
    if judged.risk is None:
        return None
    known = {one.name: one.harm_per_hour for one in judged.risk.hazards}
    accepted = judged.budget.accepted_harm_per_hour
    floor = LEAST_DRAWN * accepted
    rows = [_row(one, known.get(one.hazard.name), floor=floor) for one in judged.hazards]
    names_all = len(known) == len(judged.hazards)
    total = judged.risk.harm_per_hour
    color = BLUE if judged.outcome == "met" else VERMILLION if judged.outcome == "not met" else GREY
    name = "all hazards" if names_all else "all that are known"
    rows.append(_bar(name, total, color, floor=floor))
    rule = Rule(accepted, f"accepted: {end_text(accepted)} an hour", VERMILLION, SOLID)
    return IntervalChart("Harm an hour (line: accepted)", tuple(rows), "harm [1/h]", rules=(rule,))


def _row(one: JudgedHazard, harm: Interval | None, *, floor: float) -> Row:
    if harm is None:
        return Row(one.hazard.name, None, None, (), GREY, figures="not known", tip=one.unknown)
    return _bar(one.hazard.name, harm, BLUE, floor=floor)


def _bar(name: str, harm: Interval, color: str, *, floor: float) -> Row:
    """What is far below all that matters is drawn as 0; figures have it as it is."""
    values = (harm.value,) if harm.value > floor else ()
    low = harm.low if harm.low > floor else 0.0
    return Row(name, low, harm.high, values, color, figures=range_text(harm.low, harm.high))


def _verdict(judged: JudgedBudget) -> Section:
    verdict = doc.Verdict(MARKS[judged.outcome], verdict_sentence(judged))
    cautions = tuple(Caution(text) for text in judged.cautions)
    said: list[Block] = [verdict]
    if judged.risk is not None:
        said.append(Paragraph(_hazardous_behaviour(judged, judged.risk), "quiet"))
    chart = budget_chart(judged)
    drawn = () if chart is None else (doc.Code(characters(chart)),)
    source = Paragraph(f"Accepted by: {judged.budget.source}", "quiet")
    full = (*said, *doc.figure(chart), source, *cautions)
    return Section("verdict", "Risk budget", (*said, *drawn, *cautions), full)


def _hazardous_behaviour(judged: JudgedBudget, risk: Risk) -> str:
    """From the accepted rate of harm to one of hazardous behaviour, as hazards mix now."""
    accepted, now = judged.budget.accepted_harm_per_hour, risk.violations_per_hour
    found = f"Hazardous behaviour: {end_text(now.value)} violations an hour ({_ends(now)})"
    if risk.harm_per_hour.value <= 0.0:
        return f"{found}."
    share = risk.harm_per_hour.value / now.value
    return (
        f"{found}; {end_text(share)} of them harm, as far as known, so that "
        f"{end_text(accepted / share)} an hour would be accepted."
    )


def _ends(one: Interval) -> str:
    return range_text(one.low, one.high)


def _table(judged: JudgedBudget) -> Section:
    """A row for each factor of each hazard, and for what comes of them."""
    risks = {} if judged.risk is None else {one.name: one for one in judged.risk.hazards}
    rows, short = list[tuple[str, ...]](), list[tuple[str, ...]]()
    for one in judged.hazards:
        hazard, risk = one.hazard, risks.get(one.hazard.name)
        if risk is None:
            rows.append((hazard.name, "not known", "", "", one.unknown))
            short.append((hazard.name, "not known", "", ""))
            continue
        each = (
            (FACTORS["encounters"], risk.encounters_per_hour, hazard.encounters.source),
            (FACTORS["violation"], risk.violation, violation_source(one)),
            (FACTORS["harm"], risk.harm, harm_source(one)),
            (VIOLATIONS, risk.violations_per_hour, ""),
            (HARM, risk.harm_per_hour, ""),
        )
        for place, (name, interval, source) in enumerate(each):
            cells = ("" if place else hazard.name, name, *_figures(interval))
            rows.append((*cells, source))
            if name != VIOLATIONS:
                short.append(cells)
    if judged.risk is not None:
        total = ("all" if len(risks) == len(judged.hazards) else "all known", HARM)
        rows.append((*total, *_figures(judged.risk.harm_per_hour), ""))
        short.append((*total, *_figures(judged.risk.harm_per_hour)))
    columns = ("hazard", "", "value", "95 % interval")
    brief = Table(columns, tuple(short), numbers=(2,))
    full = Table((*columns, "source"), tuple(rows), numbers=(2,))
    return Section("hazards", "Hazards", (brief,), (full,))


def _figures(one: Interval) -> tuple[str, str]:
    """The value and its interval, with as many digits as tell the ends apart."""
    digits = digits_of(one.low, one.high)
    exact = one.low == one.high
    ends = "taken as exact" if exact else range_text(one.low, one.high, digits=digits)
    return end_text(one.value, digits=digits), ends


def violation_source(one: JudgedHazard) -> str:
    """Where P(violation) of a hazard is from."""
    if one.hazard.violation is not None:
        return one.hazard.violation.source
    words = list[str]()
    for run in one.runs:
        rule = "" if run.answer is None or run.answer.rule is None else f", {run.answer.rule.name}"
        words.append(f"run {run.name}{rule}: {_decided_by(one.hazard, run.answer)}")
    return "; ".join(words)


def _decided_by(hazard: Hazard, answer: Any) -> str:
    if hazard.uncertainty == "sampling" or answer is None:
        return "sampling alone, the error model taken for right"
    return f"range to act on, decided by {answer.open.decided_by.name}"


def harm_source(one: JudgedHazard) -> str:
    """Where P(harm) of a hazard is from; of a curve, at which impact speeds."""
    harm = None if one.factors is None else one.factors.harm
    if not isinstance(harm, CurveHarm):
        return one.hazard.harm.source
    if one.hazard.harm.impact_speed is not None:
        at = f"at {one.hazard.harm.impact_speed:g} {one.hazard.harm.speed_unit}"
    else:
        low, middle, high = (harm.speeds.quantile(share) for share in (0.1, 0.5, 0.9))
        at = (
            f"at the impact speeds of the violating rollouts, {middle:.1f} m/s (80 % from "
            f"{low:.1f} to {high:.1f})"
        )
    return f"{one.hazard.harm.source}; {at}"


def _decides(judged: JudgedBudget) -> Section | None:
    """By how much the upper end would fall if a factor were known."""
    risk = judged.risk
    if risk is None or not judged.effects:
        return None
    high = risk.harm_per_hour.high
    rows = tuple(
        (
            FACTORS[one.kind],
            " and ".join(one.hazards),
            end_text(one.high_if_known, digits=3),
            f"{max(1.0 - one.high_if_known / high, 0.0):.0%}",
        )
        for one in judged.effects
    )
    columns = ("if it were known", "of", "harm at most [1/h]", "less by")
    name = "Which factor decides"
    table = Table(columns, rows, name=name, numbers=(2, 3))
    brief = Table(columns, rows[:MOST_EFFECTS], name=name, numbers=(2, 3))
    return Section("decides", name, (brief,), (table,))


def _next(judged: JudgedBudget) -> Section:
    steps = Bullets(tuple(next_steps(judged)))
    return Section("next", "What to do next", (Paragraph("Next", "strong"), steps), (steps,))


def next_steps(judged: JudgedBudget) -> Iterator[str]:
    """What closes the budget, or would bring it nearer, with a number where there is one."""
    for one in judged.hazards:
        if one.factors is None:
            yield f"{one.hazard.name}: {one.unknown}"
    risk, accepted = judged.risk, judged.budget.accepted_harm_per_hour
    if risk is None:
        return
    total = risk.harm_per_hour
    largest = max(risk.hazards, key=lambda one: one.harm_per_hour.high)
    if total.high <= accepted:
        if judged.outcome == "met":
            yield f"nothing: the upper end may still grow {_ratio(accepted / total.high)} times"
        return
    if total.value > accepted:
        yield (
            f"as far as known, harm is {_ratio(total.value / accepted)} times as frequent as "
            f"accepted: knowing more does not close that. {largest.name} has the highest upper "
            "end: a better detector or controller, fewer such encounters, or less harm"
        )
    if judged.effects:
        yield from _steps(judged.effects[0], judged, accepted=accepted)


def _steps(effect: FactorEffect, judged: JudgedBudget, *, accepted: float) -> Iterator[str]:
    """Of the factor that decides: how far its upper end has to fall, and what brings that."""
    factor, name = effect.factor, FACTORS[effect.kind]
    high, middle = factor.ends(Draws())[1], factor.middle
    enough = effect.high_if_known <= accepted
    of = f"{name} of {' and '.join(effect.hazards)}"
    if isinstance(factor, CurveHarm):
        curve = factor.curve
        by = (
            "take one with smaller standard errors, and with their correlation if that was left out"
            if curve.intercept_std_error or curve.slope_std_error
            else "more rollouts tell better how fast violations hit"
        )
        yield (
            f"{of} decides: known exactly, it leaves harm at most "
            f"{end_text(effect.high_if_known)} an hour; {by}"
        )
        return
    if enough:
        wanted = middle * accepted / effect.high_if_known
        yield (
            f"{of} decides: with its upper end at {end_text(wanted)} or below (now "
            f"{end_text(high)}) the budget is met, if its value stays"
        )
    else:
        wanted = math.sqrt(middle * high)
        yield (
            f"{of} decides, though by itself it is not enough: known exactly, it leaves harm at "
            f"most {end_text(effect.high_if_known)} an hour; below: what halves its doubt, with an "
            f"upper end of {end_text(wanted)} (now {end_text(high)})"
        )
    yield from _means(effect, judged, wanted=wanted, high=high)


def _means(
    effect: FactorEffect, judged: JudgedBudget, *, wanted: float, high: float
) -> Iterator[str]:
    """What to drive, count, sample or label."""
    hazard = next(one for one in judged.hazards if one.hazard.name == effect.hazards[0])
    count = effect.factor.count
    if effect.kind == "violation" and hazard.runs:
        yield from _run_means(hazard, wanted=wanted, high=high, middle=effect.factor.middle)
    elif count is not None:
        drive = effect.kind == "encounters"
        needed = hours_needed(count, high=wanted)
        verb, unit = ("drive", "hours") if drive else ("observe", "trials")
        as_so_far = "as often as so far" if count.events else "none at all"
        if needed is None:
            yield f"no number of {unit} brings that"
        else:
            yield (
                f"{verb} {math.ceil(needed - count.of):,} {unit} more ({math.ceil(needed):,} in "
                f"all), if events come {as_so_far}"
            )
    else:
        yield f"data in place of {effect.factor.source!r}"


def _run_means(hazard: JudgedHazard, *, wanted: float, high: float, middle: float) -> Iterator[str]:
    """More rollouts where the sampling decides, else what narrows what does."""
    for run in hazard.runs:
        answer = run.answer
        if answer is None:
            continue
        source = answer.open.decided_by
        sampling = hazard.hazard.uncertainty == "sampling" or source.kind == "sampling"
        if sampling and middle > 0.0 and wanted > middle:
            rollouts = answer.estimate.rollouts_in_estimate
            needed = math.ceil(
                rollouts * (math.log(high / middle) / math.log(wanted / middle)) ** 2
            )
            percent = _ratio(100.0 * max(wanted / middle - 1.0, 0.005))
            yield (
                f"run {run.name}: about {needed:,} rollouts in place of {rollouts:,}: pemviz "
                f"record --config {run.folder / 'config.toml'} --precision {percent}%"
            )
            continue
        yield f"run {run.name}: {source.name} decides; narrowed by {source.narrowed_by}"
        for collect, brings in short_rows(run.result):
            yield f"run {run.name}: {collect}: {brings}"
        if run.result.plan is None:
            yield f"what to label: pemviz record --config {run.folder / 'config.toml'} --plan"


def _method(judged: JudgedBudget) -> Section:
    about = tuple(Paragraph(text) for text in METHOD)
    file = doc.facts(
        [("budget", str(judged.path)), ("digest (SHA-256)", doc.Verbatim(judged.digest))]
    )
    return Section("method", "How it is combined", (), (*about, file))


def budget_json(judged: JudgedBudget) -> dict[str, Any]:
    """The same for programs; ``null`` where nothing is known."""
    risk = judged.risk
    risks = {} if risk is None else {one.name: one for one in risk.hazards}

    def interval(one: Interval | None) -> dict[str, float] | None:
        return None if one is None else {"value": one.value, "low": one.low, "high": one.high}

    names = (
        "encounters_per_hour", "violation", "violations_per_hour", "harm", "harm_per_hour",
    )  # fmt: skip
    return {
        "schema": 1,
        "name": judged.budget.name,
        "outcome": judged.outcome,
        "accepted_harm_per_hour": judged.budget.accepted_harm_per_hour,
        "source": judged.budget.source,
        "digest": judged.digest,
        "harm_per_hour": interval(None if risk is None else risk.harm_per_hour),
        "violations_per_hour": interval(None if risk is None else risk.violations_per_hour),
        "hazards": [
            {
                "name": one.hazard.name,
                "runs": [str(run.folder) for run in one.runs],
                "rule": one.hazard.rule,
                "uncertainty": one.hazard.uncertainty,
                "unknown": one.unknown or None,
                **{
                    name: interval(getattr(risks.get(one.hazard.name), name, None))
                    for name in names
                },
            }
            for one in judged.hazards
        ],
        "decided_by": [
            {
                "factor": one.kind,
                "hazards": list(one.hazards),
                "harm_per_hour_high_if_known": one.high_if_known,
            }
            for one in judged.effects
        ],
        "next": list(next_steps(judged)),
        "cautions": list(judged.cautions),
    }
