"""A run's result as a document: what every medium tells of it, decided once.

:func:`run_document` makes the sections; words and rows of a subject stand in its own file, charts
in :mod:`pemviz.reports.charts`. A figure that is new in the result gets a section here.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping

from pemviz.analysis.starts import DangerousStarts
from pemviz.config import ExperimentConfig
from pemviz.config.encounters import NO_LOGICAL_SCENARIO
from pemviz.config.toml_files import config_text
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.reports.causes_words import (
    BURST_COLUMNS,
    BURST_NOTE,
    BURST_TITLE,
    band_columns,
    band_note,
    band_rows,
    burst_lines,
    burst_rows,
    causes_line,
    chain_table,
)
from pemviz.reports.charts import (
    interval_chart,
    memory_chart,
    models_chart,
    requirement_chart,
    starts_chart,
    uncertainty_chart,
)
from pemviz.reports.document import (
    Block,
    Bullets,
    Caution,
    Code,
    Document,
    Folded,
    Headline,
    Mark,
    Paragraph,
    Section,
    Table,
    Verbatim,
    Verdict,
    facts,
    figure,
)
from pemviz.reports.estimate_words import (
    aimed_text,
    beyond_default_text,
    data_text,
    interval_name,
    interval_text,
    model_range_text,
    position_errors_text,
    probability_text,
    reference_text,
    short_probability,
    violations_text,
)
from pemviz.reports.gate import GateDecision, GateOutcome
from pemviz.reports.memory_words import (
    BY_MEMORY_TIME,
    CURVE_AXES,
    MEMORY_TITLE,
    NOT_LOOKED_AT,
    CurveAxis,
    assumption_lines,
    curve_columns,
    curve_rows,
    memory_text,
)
from pemviz.reports.numbers import number_text, share_text
from pemviz.reports.plan_words import (
    BAND_NOTE,
    PLAN_COLUMNS,
    plan_heading,
    plan_rows,
    plan_sentences,
    short_rows,
)
from pemviz.reports.rates_words import rate_columns, rate_line, rate_note, rate_rows, unit_of
from pemviz.reports.rules_words import RULE_COLUMNS, RULES_TITLE, rule_rows, rule_warnings
from pemviz.reports.run_words import budget_text, kept_text, scenario_text
from pemviz.reports.starts_words import (
    START_COLUMNS,
    START_NOTE,
    STARTS_TITLE,
    map_words,
    start_rows,
    starts_line,
    starts_title,
)
from pemviz.reports.uncertainty_words import (
    NOT_ADDED_UP,
    UNCERTAINTY_COLUMNS,
    UNCERTAINTY_TITLE,
    uncertainty_rows,
)
from pemviz.runs.memory import RunMemory
from pemviz.runs.result import RunResult
from pemviz.runs.trust import data_warnings, run_diagnostics, run_interval_caveats
from pemviz.sampling.estimates.diagnostics import RELIABLE_PARETO_K, SMALL_ESS
from pemviz.sampling.estimates.trust import interval_caveats, remedy
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

ANSWER = ("gate", "answer", "given", "rules", "rates", "memory", "uncertainty", "plan")
"""How likely, and how far that is open."""
WHY = ("causes", "starts", "robustness")
"""What violations are like, and what rollouts are like without one."""
TRUST = ("diagnostics", "models", "warnings", "extrapolation")
"""Whether to believe it."""
RECORD = ("question", "worst", "provenance", "assumptions", "configuration")
"""What was done."""
MOST_WARNINGS = 5
"""Lines of them in brief."""
UNWEIGHTED = (
    "{}'s rollouts carry no weights, so there is nothing to diagnose and no sensitivity: "
    "its standard error comes from how far its independent runs differ."
)
GATE_MARKS: Mapping[GateOutcome, Mark] = {"passed": "yes", "tripped": "no", "undecided": "open"}


def run_document(
    result: RunResult, *, gate: GateDecision | None = None, running: bool = False
) -> Document:
    """All sections that have something to say.

    Args:
        result: The run.
        gate: The gate's decision, if there is a gate.
        running: Whether the run still goes on.
    """
    found = [
        _gate(gate),
        _answer(result, gate=gate, running=running),
        _warnings(result),
        _extrapolation(result),
        _question(result),
        _worst(result),
        _provenance(result),
        _assumptions(result),
        _configuration(result.config),
    ]
    if result.estimate is not None:
        found += [
            _given_section(result),
            _rules(result),
            _rates(result),
            _models(result),
            _memory(result),
            _uncertainty(result),
            _plan(result),
            _causes(result),
            _starts(result),
            _robustness(result),
            _diagnostics(result, result.estimate),
        ]
    return Document("pemviz", tuple(section for section in found if section is not None))


def _gate(gate: GateDecision | None) -> Section | None:
    if gate is None:
        return None
    said = (Verdict(GATE_MARKS[gate.outcome], f"Gate {gate.sentence}"),)
    return Section("gate", "Gate", said, said)


def _answer(result: RunResult, *, gate: GateDecision | None, running: bool) -> Section:
    """The probability with its interval, counts and what stands beside it."""
    status, estimate = _status(result, running=running), result.estimate
    if estimate is None:
        title = "The run goes on" if running else f"No estimate: the run {result.status}"
        return Section("answer", title, (Headline(title), *status), (Headline(title), *status))
    headline = Headline(
        f"Failure probability {short_probability(estimate)}", _given(result.config, result)
    )
    return Section(
        key="answer",
        title="Failure probability",
        brief=(headline, *status, *map(_quiet, _lines(result, estimate))),
        full=(headline, *status, *_full(result, estimate, gate)),
    )


def _quiet(text: str) -> Paragraph:
    return Paragraph(text, tone="quiet")


def _given(config: ExperimentConfig, result: RunResult) -> str:
    logical_scenario = config.encounter.logical_scenario
    occasion = (
        "run" if logical_scenario == NO_LOGICAL_SCENARIO else f"encounter of {logical_scenario}"
    )
    asked = beyond_default_text(result)
    beside = f"; with {asked}" if asked else ""
    return f"in one {occasion}, if error model {result.pem.name} is right{beside}"


def _status(result: RunResult, *, running: bool) -> list[Block]:
    if running:
        return [_quiet(f"Stages done so far: {len(result.stages)}.")]
    if result.status == "done":
        return []
    reason = f": {result.message}" if result.message else ""
    return [Caution(f"The run {result.status}{reason}. The figures are of what was done.")]


def _lines(result: RunResult, estimate: Estimate) -> Iterator[str]:
    """What a line each tells of the answer."""
    config, caveats = result.config, run_interval_caveats(result)
    called = interval_name(estimate, caveats=caveats)
    alone = "" if caveats else ", sampling alone; what else leaves it open is below"
    yield f"{called} {interval_text(estimate, caveats=caveats)}{alone}"
    repeated = f" in {len(result.repetitions)} repetitions" * (len(result.repetitions) > 1)
    what = f"any of {len(config.rules)} rules" if config.rules else config.spec
    yield (
        f"{config.method}{repeated}: {violations_text(estimate)}{aimed_text(estimate)} violate "
        f"{what}; took {result.timings_s.get('total', math.nan):.1f} s"
    )
    if caveats:
        yield f"try next: {remedy(estimate.method, latents=result.latents is not None)}"
    if rate := rate_line(result):
        yield rate
    if result.reference is not None:
        yield f"reference {reference_text(result.reference, estimate)}"


def _full(result: RunResult, estimate: Estimate, gate: GateDecision | None) -> Iterator[Block]:
    caveats = run_interval_caveats(result)
    if caveats or estimate.warnings:
        yield Caution("Read the warnings before quoting this.")
    rows = [
        ("probability of a violation", probability_text(estimate)),
        ("log10", number_text(estimate.log10_probability, digits=4)),
        (interval_name(estimate, caveats=caveats), interval_text(estimate, caveats=caveats)),
        ("misses", memory_text(result.memory)),
        ("range over refits", model_range_text(result.pem_interval)),
    ]
    if result.reference is not None:
        rows.append(("reference", reference_text(result.reference, estimate)))
    if result.data_bound is not None:
        words = f"below {result.data_bound.probability:.2g} "
        words += f"(confidence {result.data_bound.confidence:.0%})"
        rows.append(("by the error model's data alone", words))
    rows.append(("violations", violations_text(estimate)))
    yield facts(rows)
    chart = interval_chart(result, limit=None if gate is None else gate.limit)
    yield from figure(chart, caption=_chart_words(result))


def _chart_words(result: RunResult) -> str:
    """What the intervals of the chart are."""
    said = [run_interval_caveats(result)]
    if len(result.repetitions) > 1:
        said += [interval_caveats(one) for one in result.repetitions]
    dotted = "; dotted is not a 95 % interval (the table and the warnings say why)" * any(said)
    return f"Probability with its interval, logarithmic axis{dotted}:"


def _given_section(result: RunResult) -> Section:
    """What the answer rests on: the model's data, how misses hang together, what measures."""
    config = result.config
    lines = [
        f"{result.pem.name} learnt from {data_text(result.pem)}",
        f"misses {memory_text(result.memory)}",
    ]
    if config.scenario.tracker != NO_TRACKER:
        lines.append(f"tracker between perception and controller: {config.scenario.tracker}")
    if result.position_errors is not None:
        lines.append(f"measured distance: {position_errors_text(result.position_errors)}")
    if result.latents is not None:
        lines.append(f"latents (standard normals): {result.latents}")
    blocks = tuple(map(_quiet, lines))
    return Section("given", "What it takes for granted", blocks, blocks)


def _diagnostics(result: RunResult, estimate: Estimate) -> Section:
    """The estimate's figures beside what they should be; in full only."""
    rows = [
        ("standard error", number_text(estimate.std_error), ""),
        ("rollouts simulated", f"{estimate.rollouts_simulated}", ""),
        ("rollouts in the estimate", f"{estimate.rollouts_in_estimate}", ""),
        ("of these, violations", f"{estimate.failures}", "at least ten"),
        ("mean NLL of the violations", number_text(estimate.nll_mean, unit="nats", digits=4), ""),
        (
            "NLL of their mean likelihood",
            number_text(estimate.nll_log_mean, unit="nats", digits=4),
            "",
        ),
    ]
    if estimate.ess is not None:
        rows += [
            ("effective sample size", number_text(estimate.ess), f"{SMALL_ESS:g} or more"),
            ("Pareto k-hat", number_text(estimate.pareto_k), f"{RELIABLE_PARETO_K:g} or less"),
            ("largest weight's share", share_text(estimate.max_weight_share), "a few per cent"),
        ]
    method = by_name(result.config.method)
    remarks: list[Block] = []
    if not method.has_likelihood_ratios:
        remarks.append(_quiet(UNWEIGHTED.format(method.name.capitalize())))
    if method.interval_caveat is not None:
        remarks.append(_quiet(f"The interval: {method.interval_caveat}."))
    table = Table(("figure", "found", "wanted"), tuple(rows), name="Diagnostics of the sampling")
    return Section("diagnostics", "Diagnostics of the sampling", (), (*remarks, table))


def _rules(result: RunResult) -> Section | None:
    """Each rule's answer; ``None`` without rules."""
    if not result.rules:
        return None
    table = Table(RULE_COLUMNS, tuple(rule_rows(result)), name=RULES_TITLE)
    full = (
        Paragraph("The probability above is of any of them being broken."),
        table,
        *map(Caution, rule_warnings(result)),
    )
    return Section("rules", RULES_TITLE, (table,), full)


def _rates(result: RunResult) -> Section | None:
    """The rates of all that is violated and of each rule; ``None`` where none are told."""
    rows = rate_rows(result)
    if not rows:
        return None
    title = unit_of(result).title
    table = Table(rate_columns(result), tuple(rows), name=title)
    brief = (table,) if len(rows) > 1 else ()
    full = (Paragraph(f"{rate_line(result)}."), table, _quiet(rate_note(result)))
    return Section("rates", title, brief, full)


def _memory(result: RunResult) -> Section:
    """The assumptions' worth in a line each, and the answer along both axes."""
    memory = result.memory
    lines = tuple(Paragraph(line, tone="strong") for line in assumption_lines(memory))
    if memory is None or not lines:
        return Section("memory", MEMORY_TITLE, (), (Caution(NOT_LOOKED_AT),))
    brief = (*lines, *_along(memory, BY_MEMORY_TIME, instead=True))
    full = (*lines, *(block for axis in CURVE_AXES for block in _along(memory, axis)))
    return Section("memory", MEMORY_TITLE, brief, full)


def _along(memory: RunMemory, axis: CurveAxis, *, instead: bool = False) -> tuple[Block, ...]:
    """Chart and table of a curve, or the table only ``instead`` of the chart; empty without."""
    rows = [
        (row.place, row.probability, row.interval, row.measured) for row in curve_rows(memory, axis)
    ]
    if not rows:
        return ()
    table = Table(
        curve_columns(memory, axis), tuple(rows), name=axis.title, note=axis.note, numbers=(0, 1)
    )
    chart = memory_chart(memory, axis)
    if instead:
        return figure(chart, caption=axis.note, words=(table,))
    return (*figure(chart, caption=""), table)


def _uncertainty(result: RunResult) -> Section | None:
    """The sources, as a table and drawn; ``None`` without an estimate."""
    rows = uncertainty_rows(result)
    if not rows:
        return None
    table = Table(UNCERTAINTY_COLUMNS, tuple(rows), numbers=(1, 2))
    chart = uncertainty_chart(result)
    full = (*figure(chart, caption=NOT_ADDED_UP, words=(Paragraph(NOT_ADDED_UP),)), table)
    return Section("uncertainty", UNCERTAINTY_TITLE, figure(chart, words=(table,)), full)


def _models(result: RunResult) -> Section | None:
    """The answer under other error models; ``None`` without any."""
    chart = models_chart(result)
    if chart is None:
        return None
    words = (
        "All from the same rollouts, with other weights. No one's labels say which model is right "
        "where there are none."
    )
    if result.pem_interval is not None:
        words = f"Range over refits: {model_range_text(result.pem_interval)}. {words}"
    rows = tuple((row.name, row.figures) for row in chart.rows)
    table = Table(("error model", "probability of a violation"), rows)
    blocks = figure(chart, caption=words, words=(table, _quiet(words)))
    return Section("models", chart.title, (), blocks)


def _plan(result: RunResult) -> Section | None:
    """What to collect and what it would bring; ``None`` if it was not asked for."""
    plan = result.plan
    if plan is None:
        return None
    lines = tuple(f"{collect}: {then}" for collect, then in short_rows(result))
    refused = () if plan.reason is None else (f"no labels are planned: {plan.reason}",)
    full: list[Block] = [Bullets(tuple(plan_sentences(result)))]
    if plan.labels is not None:
        full += figure(requirement_chart(plan.labels))
        every = tuple(range(len(PLAN_COLUMNS)))
        rows = tuple(plan_rows(plan.labels))
        full.append(Table(PLAN_COLUMNS, rows, note=BAND_NOTE, numbers=every))
    return Section("plan", plan_heading(plan), (Bullets((*refused, *lines)),), tuple(full))


def _starts(result: RunResult) -> Section | None:
    """Where violations start and all starts do not; ``None`` without named starts."""
    if not result.starts:
        return None
    lines = [
        starts_line(found) if found.rule is None else f"{found.rule}: {starts_line(found)}"
        for found in result.starts
    ]
    brief: list[Block] = [Paragraph(lines[0]), *_drawn(result.starts[0], instead=True)]
    full: list[Block] = [Paragraph(START_NOTE, tone="quiet")]
    for found, line in zip(result.starts, lines, strict=True):
        full += [Paragraph(f"{line}."), *_drawn(found, instead=False)]
        rows = tuple(start_rows(found))
        full.append(Table(START_COLUMNS, rows, name=starts_title(found)))
    return Section("starts", STARTS_TITLE, tuple(brief), tuple(full))


def _drawn(found: DangerousStarts, *, instead: bool) -> tuple[Block, ...]:
    """The plane of two start values; where it cannot be drawn, why, unless ``instead``."""
    chart = starts_chart(found)
    if chart is None:
        return () if instead else (Paragraph(map_words(found), tone="quiet"),)
    return figure(chart, caption=map_words(found), target="start" if found.points else "")


def _causes(result: RunResult) -> Section:
    """Where misses lie before a violation, how they hang together, and the likeliest chains."""
    title, explanation = "Misses that cause it", result.explanation
    if explanation is None:
        none = "No weighted violation was seen that tells where misses matter."
        return Section("causes", title, (), (Paragraph(none),))
    target = result.config.target
    lines = tuple(map(Paragraph, (causes_line(explanation), *burst_lines(explanation))))
    tables: list[Block] = []
    if explanation.misses_by_distance:
        tables.append(
            Table(
                band_columns(target),
                tuple(band_rows(explanation, target=target)),
                name="Misses by distance, and what fewer of them would bring",
                note=band_note(result),
                numbers=(1, 2, 3),
            )
        )
    if bursts := burst_rows(explanation, target=target):
        tables.append(Table(BURST_COLUMNS, tuple(bursts), name=BURST_TITLE, note=BURST_NOTE))
    full = [*lines[:1], *tables]
    if chains := chain_table(explanation.chains, dt_s=result.config.dt_s):
        full.append(chains)
    return Section("causes", title, lines if target is None else tuple(tables), tuple(full))


def _robustness(result: RunResult) -> Section:
    """How robust rollouts are under the error model: expected, and in the worst hundredth."""
    title, found = "Robustness under the error model", result.robustness_tail
    if found is None:
        words = (
            "Not told: too few of the rollouts show what usually happens; plain rollouts "
            "(--method monte-carlo) do."
        )
        return Section("robustness", title, (), (_quiet(words),))
    unit = "" if result.config.metric == "agm" else " m"
    expected = f"{found.expected:.4g}{unit} +- {found.expected_std_error:.1g}"
    worst, quantile = "not known: too few were drawn", "not known"
    if found.worst is not None and found.worst_std_error is not None:
        worst = f"{found.worst:.4g}{unit} +- {found.worst_std_error:.1g}"
        quantile = f"{found.quantile:.4g}{unit}"
    line = f"Robustness: {expected} expected; mean of the worst {found.worst_share:.0%}: {worst}"
    rows = (
        ("expected", expected),
        (f"mean of the worst {found.worst_share:.0%} (conditional value at risk)", worst),
        (f"quantile at {found.worst_share:.0%}", quantile),
        ("by rollouts", f"{found.rollouts:,}, weighted as the error model has them"),
    )
    return Section("robustness", title, (Paragraph(line),), (facts(rows),))


def _warnings(result: RunResult) -> Section:
    """What is wrong with the answer; in brief the gravest, and what else there is."""
    about_answer = [diagnostic.text for diagnostic in run_diagnostics(result)]
    if result.estimate is None:
        said = Paragraph("None so far; there is no estimate yet.")
        blocks = (said if result.message is None else Caution(result.message),)
        return Section("warnings", "Warnings", (), blocks)
    about_refits = () if result.pem_interval is None else result.pem_interval.warnings
    grave = (*about_answer, *rule_warnings(result), *about_refits)
    shown = grave[: MOST_WARNINGS - 1]
    others = [text for text in data_warnings(result) if text not in about_refits]
    kinds = Counter(text.partition(":")[0] if ":" in text[:40] else "others" for text in others)
    kinds["more about the answer"] = len(grave) - len(shown)
    named = [f"{kind} ({count})" if count > 1 else kind for kind, count in kinds.items() if count]
    brief = [*shown, *([f"{', '.join(named)}; --verbose tells each"] if named else [])]
    full = tuple(map(Caution, about_answer))
    fine = (Verdict("yes", "The diagnostics of the sampling give no warning."),)
    return Section("warnings", "Warnings", tuple(map(Caution, brief)), full or fine)


def _extrapolation(result: RunResult) -> Section | None:
    """Where the error model goes beyond its data; ``None`` where nowhere."""
    found = tuple(map(Caution, data_warnings(result)))
    if not found:
        return None
    title = "Extrapolated: where the error model has little or no data"
    return Section("extrapolation", title, (), found)


def _question(result: RunResult) -> Section:
    config = result.config
    ranked = f"{config.metric} robustness; whether one violates is decided by the formula itself"
    rows = [
        ("specification", Verbatim(config.spec)),
        ("scenario", scenario_text(config)),
        ("error model", Verbatim(result.pem.name)),
        ("method", f"{config.method}, back end {config.simulator}"),
        ("budget", budget_text(config)),
        ("rollouts are ranked by", ranked),
    ]
    return Section("question", "What was asked", (), (facts(rows),))


def _worst(result: RunResult) -> Section | None:
    """The least robust rollout that carries the answer, if any does."""
    if not result.least_robust:
        return None
    worst, config = result.least_robust[0], result.config
    steps = f" of {config.scenario.states - 1} steps" if config.is_braking_scenario else ""
    rows = [
        ("robustness", f"{worst.robustness:.3g} ({config.metric})"),
        ("verdict", "violates" if worst.violated else "holds"),
        ("missed detections", f"{worst.misses}{steps}"),
        ("NLL under the error model", f"{worst.nll:.4g} nats"),
        ("log weight", f"{worst.log_weight:.4g} nats"),
        (
            "where in rollouts.npz",
            f"repetition {worst.repetition}, stage {worst.stage}, rollout {worst.rollout}",
        ),
    ]
    if worst.broken:
        rows.insert(2, ("rules that it breaks", ", ".join(worst.broken)))
    if worst.share is not None:
        rows.insert(1, ("share of its stage's estimate", share_text(worst.share)))
    which = "least robust of all" if worst.share is None else "least robust that carries the answer"
    return Section("worst", f"Worst rollout, {which}", (), (facts(rows),))


def _provenance(result: RunResult) -> Section:
    """Where the numbers come from."""
    status = result.status if result.message is None else f"{result.status}: {result.message}"
    timings = ", ".join(
        f"{part} {seconds:.2f} s" for part, seconds in result.timings_s.items() if part != "total"
    )
    total = f"{result.timings_s.get('total', math.nan):.1f} s"
    rows: list[tuple[str, str]] = [
        ("run", Verbatim(result.run_id)),
        ("status", status),
        ("perception error model", Verbatim(result.pem.name)),
        ("its data", result.pem.data),
        ("its digest (SHA-256)", Verbatim(result.pem.digest)),
        ("seed", str(result.config.seed)),
        ("versions", ", ".join(f"{name} {version}" for name, version in result.versions.items())),
        ("wall time", f"{total} ({timings})" if timings else total),
    ]
    if kept := kept_text(result.config):
        rows.append(("rollouts in its files", kept))
    return Section("provenance", "Provenance", (), (facts(rows),))


def _assumptions(result: RunResult) -> Section:
    return Section("assumptions", "Assumed", (), (Bullets(result.assumptions),))


def _configuration(config: ExperimentConfig) -> Section:
    code = Code(config_text(config), language="toml")
    return Section(
        "configuration", "Configuration", (), (Folded("Complete configuration", (code,)),)
    )
