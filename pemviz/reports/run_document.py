"""A run's result as a document: what every medium tells of it, decided once.

:func:`run_document` makes the sections; words and rows of a subject stand in its own file, charts
in :mod:`pemviz.reports.charts`. A figure that is new in the result gets a section here.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import fields

from pemviz.analysis.starts import DangerousStarts
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import config_text
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.reports import (
    answer_words,
    causes_words,
    charts,
    headline_words,
    memory_words,
    plan_words,
)
from pemviz.reports import document as doc
from pemviz.reports import estimate_words as estimates
from pemviz.reports.document import Block, Caution, Document, Paragraph, Section, figure
from pemviz.reports.estimate_words import number_text, share_text
from pemviz.reports.gate import GateDecision, GateOutcome
from pemviz.runs.answers import answers
from pemviz.runs.ranking import LEAST_ROBUST
from pemviz.runs.result import OwnSystem, RunMemory, RunResult
from pemviz.runs.uncertainty import (
    data_warnings,
    run_diagnostics,
    run_interval_caveats,
    run_remedy,
)
from pemviz.sampling.estimates.diagnostics import RELIABLE_PARETO_K, SMALL_ESS
from pemviz.sampling.estimates.trust import interval_caveats
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
K_HAT = f"{RELIABLE_PARETO_K:g} or less (less for few), or a tail that carries little"
MOST_WARNINGS = 5
"""Lines of them in brief."""
GATE_MARKS: Mapping[GateOutcome, doc.Mark] = {"passed": "yes", "tripped": "no", "undecided": "open"}


def run_document(
    result: RunResult, *, gate: GateDecision | None = None, running: bool = False
) -> Document:
    """All sections that have something to say; ``running``: of a run that still goes on."""
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
    said = (doc.Verdict(GATE_MARKS[gate.outcome], f"Gate {gate.sentence}"),)
    return Section("gate", "Gate", said, said)


def _answer(result: RunResult, *, gate: GateDecision | None, running: bool) -> Section:
    status, estimate = _status(result, running=running), result.estimate
    if estimate is None:
        title = "The run goes on" if running else f"No estimate: the run {result.status}"
        said = (doc.Headline(title), *status)
        return Section("answer", title, said, said)
    said = tuple(headline_words.headline_blocks(result, running=running))
    brief = (*said, *status, *map(_quiet, _lines(result, estimate)))
    full = (*said, *status, *_full(result, estimate, gate))
    return Section("answer", "Failure probability", brief, full)


def _quiet(text: str) -> Paragraph:
    return Paragraph(text, tone="quiet")


def _status(result: RunResult, *, running: bool) -> list[Block]:
    if running:
        return [_quiet(f"Stages done so far: {len(result.stages)}.")]
    if result.status == "done":
        return []
    reason = f": {result.message}" if result.message else ""
    return [Caution(f"The run {result.status}{reason}. The figures are of what was done.")]


def _lines(result: RunResult, estimate: Estimate) -> Iterator[str]:
    """What a line each tells of the answer."""
    config, first = result.config, answers(result)[0]
    called = estimates.interval_name(first.estimate, caveats=first.caveats)
    alone = "" if first.caveats else ", sampling alone; what else leaves it open is below"
    yield f"{called} {estimates.interval_text(first.estimate, caveats=first.caveats)}{alone}"
    repeated = f" in {len(result.repetitions)} repetitions" * (len(result.repetitions) > 1)
    what = f"any of {len(config.rules)} rules" if config.rules else config.spec
    counted = estimates.violations_text(estimate) + estimates.missing_more_text(estimate)
    yield (
        f"{estimates.method_text(result)}{repeated}: {counted} violate {what}; took "
        f"{result.timings_s.get('total', math.nan):.1f} s"
    )
    if chosen := estimates.chosen_text(result):
        yield chosen
    if learned := estimates.surrogate_text(result):
        yield learned
    yield from estimates.next_text(run_remedy(result))
    if rate := answer_words.rate_line(result):
        yield rate
    if result.reference is not None:
        yield f"reference {estimates.reference_text(result.reference, estimate)}"


def _full(result: RunResult, estimate: Estimate, gate: GateDecision | None) -> Iterator[Block]:
    caveats = run_interval_caveats(result)
    if caveats or estimate.warnings:
        yield Caution("Read the warnings before quoting this.")
    yield from map(Paragraph, estimates.next_text(run_remedy(result)))
    called = estimates.interval_name(estimate, caveats=caveats)
    count = len(result.config.rules)  # the headline's answer is to one rule, these are to any
    of_any = f", any of {count} rules" if count else ""
    rows = [
        (f"probability of a violation{of_any}", estimates.probability_text(estimate)),
        ("log10", number_text(estimate.log10_probability, digits=4)),
        (f"{called}{of_any}", estimates.interval_text(estimate, caveats=caveats)),
        ("misses", memory_words.memory_text(result)),
    ]
    if not result.is_of_detector_itself:
        rows.append((f"range over refits{of_any}", estimates.model_range_text(result.pem_interval)))
    if result.reference is not None:
        rows.append(("reference", estimates.reference_text(result.reference, estimate)))
    if result.data_bound is not None:
        words = f"below {result.data_bound.probability:.2g} "
        words += f"(confidence {result.data_bound.confidence:.0%})"
        rows.append(("by the error model's data alone", words))
    rows.append(("violations", estimates.violations_text(estimate)))
    yield doc.facts(rows)
    chart = charts.interval_chart(result, limit=None if gate is None else gate.limit)
    several = result.repetitions if len(result.repetitions) > 1 else ()
    dotted = ""
    if caveats or any(map(interval_caveats, several)):
        dotted = "; dotted is not a 95 % interval (the table and the warnings say why)"
    yield from figure(chart, caption=f"Probability with its interval, logarithmic axis{dotted}.")


def _given_section(result: RunResult) -> Section:
    """What the answer rests on: the model's data, how misses hang together, what measures."""
    config = result.config
    lines = [
        estimates.model_text(result.pem),
        f"misses {memory_words.memory_text(result)}",
    ]
    if result.is_of_detector_itself:
        lines = lines[1:]
    if config.scenario.tracker != NO_TRACKER:
        lines.append(f"tracker between perception and controller: {config.scenario.tracker}")
    if result.position_errors is not None:
        errors = result.position_errors
        known = estimates.data_text(errors)
        lines.append(f"measured distance: with errors of {errors.name}, from {known}")
    if result.latents is not None:
        lines.append(f"latents (standard normals): {result.latents}")
    blocks = tuple(map(_quiet, lines))
    return Section("given", "What it takes for granted", blocks, blocks)


def _diagnostics(result: RunResult, estimate: Estimate) -> Section:
    """The estimate's figures beside what they should be; in full only."""
    mean, of_mean = (
        number_text(nll, unit="nats", digits=4)
        for nll in (estimate.nll_mean, estimate.nll_log_mean)
    )
    rows = [
        ("standard error", number_text(estimate.std_error), ""),
        ("rollouts simulated", f"{estimate.rollouts_simulated}", ""),
        ("rollouts in the estimate", f"{estimate.rollouts_in_estimate}", ""),
        ("of these, violations", f"{estimate.failures}", "at least ten"),
        ("mean NLL of the violations", mean, ""),
        ("NLL of their mean likelihood", of_mean, ""),
    ]
    if estimate.ess is not None:
        rows += [
            ("effective sample size", number_text(estimate.ess), f"{SMALL_ESS:g} or more"),
            ("Pareto k-hat", number_text(estimate.pareto_k), K_HAT),
            ("largest weight's share", share_text(estimate.max_weight_share), "a few per cent"),
        ]
    method = by_name(result.config.method)
    remarks: list[Block] = []
    if not method.has_likelihood_ratios:
        words = (
            f"{method.name.capitalize()}'s rollouts carry no weights, so there is nothing to "
            "diagnose and no sensitivity: its standard error comes from how far its independent "
            "runs differ."
        )
        remarks.append(_quiet(words))
    if method.interval_caveat is not None:
        remarks.append(_quiet(f"The interval: {method.interval_caveat}."))
    title = "Diagnostics of the sampling"
    table = doc.Table(("figure", "found", "wanted"), tuple(rows), name=title)
    return Section("diagnostics", title, (), (*remarks, table))


def _rules(result: RunResult) -> Section | None:
    if not result.rules:
        return None
    table = headline_words.answers_table(result)
    said = answer_words.rule_warnings(result)
    return Section("rules", table.name, (table,), (table, *map(Caution, said)))


def _rates(result: RunResult) -> Section | None:
    table = answer_words.rates_table(result)
    if table is None:
        return None
    line = Paragraph(f"{answer_words.rate_line(result)}.")
    brief = (table,) if len(table.rows) > 1 else ()
    full = (line, table, _quiet(answer_words.rate_note(result)))
    return Section("rates", table.name, brief, full)


def _memory(result: RunResult) -> Section | None:
    """By how much each assumption changes the answer, and the answer along both axes."""
    if result.is_of_detector_itself:
        return None
    memory, title = result.memory, memory_words.MEMORY_TITLE
    checked = tuple(map(Paragraph, memory_words.check_lines(memory)))
    lines = [Paragraph(line, "strong") for line in memory_words.assumption_lines(memory)]
    if memory is None or not lines:
        table = None if memory is None else memory_words.measured_table(memory)
        said = Caution(memory_words.not_looked_at(result)) if table is None else table
        return Section("memory", title, checked, (*checked, said))
    lines += checked
    by_time = memory_words.BY_MEMORY_TIME
    table = memory_words.curve_table(memory, by_time)
    words = () if table is None else (table,)
    chart = charts.memory_chart(memory, by_time)
    brief = (*lines, *figure(chart, caption=by_time.note, words=words)) if words else (*lines,)
    full = (*lines, *(b for axis in memory_words.CURVE_AXES for b in _curve(memory, axis)))
    return Section("memory", title, brief, full)


def _curve(memory: RunMemory, axis: memory_words.CurveAxis) -> tuple[Block, ...]:
    table = memory_words.curve_table(memory, axis)
    return () if table is None else (*figure(charts.memory_chart(memory, axis)), table)


def _uncertainty(result: RunResult) -> Section | None:
    table, chart = answer_words.uncertainty_table(result), charts.uncertainty_chart(result)
    if table is None:
        return None
    words = answer_words.NOT_ADDED_UP
    full = (*figure(chart, caption=words, words=(Paragraph(words),)), table)
    title = answer_words.uncertainty_title(result)
    return Section("uncertainty", title, figure(chart, words=(table,)), full)


def _models(result: RunResult) -> Section | None:
    chart = charts.models_chart(result)
    if chart is None:
        return None
    words = (
        "All from the same rollouts, with other weights. No one's labels say which model is right "
        "where there are none."
    )
    if result.pem_interval is not None:
        words = f"Range over refits: {estimates.model_range_text(result.pem_interval)}. {words}"
    rows = tuple((row.name, row.figures) for row in chart.rows)
    table = doc.Table(("error model", "probability of a violation"), rows)
    blocks = figure(chart, caption=words, words=(table, _quiet(words)))
    return Section("models", chart.title, (), blocks)


def _plan(result: RunResult) -> Section | None:
    plan = result.plan
    if plan is None:
        return None
    lines = tuple(f"{collect}: {then}" for collect, then in plan_words.short_rows(result))
    refused = () if plan.reason is None else (f"no labels are planned: {plan.reason}",)
    full: list[Block] = [doc.Bullets(tuple(plan_words.plan_sentences(result)))]
    if plan.labels is not None:
        full += figure(charts.requirement_chart(plan.labels))
        full.append(plan_words.plan_table(plan.labels))
    title = plan_words.plan_heading(plan)
    return Section("plan", title, (doc.Bullets((*refused, *lines)),), tuple(full))


def _starts(result: RunResult) -> Section | None:
    if not result.starts:
        return None
    lines = [
        ("" if found.rule is None else f"{found.rule}: ") + causes_words.starts_line(found)
        for found in result.starts
    ]
    brief: list[Block] = [Paragraph(lines[0])]
    if charts.starts_chart(result.starts[0]) is not None:
        brief += _map(result.starts[0])
    full: list[Block] = [
        _quiet(
            "Starts of violations, each counted by its part of the answer, against all starts "
            "that the scenario draws."
        )
    ]
    for found, line in zip(result.starts, lines, strict=True):
        full += [Paragraph(f"{line}."), *_map(found), causes_words.starts_table(found)]
    return Section("starts", "Which starts are dangerous", tuple(brief), tuple(full))


def _map(found: DangerousStarts) -> tuple[Block, ...]:
    """The plane of two start values; where it cannot be drawn, why."""
    chart, words = charts.starts_chart(found), causes_words.map_words(found)
    if chart is None:
        return (_quiet(words),)
    return figure(chart, caption=words, target="start" if found.points else "")


def _causes(result: RunResult) -> Section:
    """Where misses lie before a violation, how they hang together, and the likeliest chains."""
    title, explanation = "Misses that cause it", result.explanation
    if explanation is None:
        none = "No weighted violation was seen that shows where misses matter."
        return Section("causes", title, (), (Paragraph(none),))
    target = result.config.target
    line = Paragraph(causes_words.causes_line(explanation))
    found = (
        causes_words.band_table(result, explanation),
        causes_words.burst_table(explanation, target=target),
        causes_words.chain_table(explanation.chains, dt_s=result.config.dt_s),
    )
    bands, bursts, chains = ([] if table is None else [table] for table in found)
    brief = (line, *map(Paragraph, causes_words.burst_lines(explanation)))
    if target is not None:
        brief = (*bands, *bursts)
    return Section("causes", title, brief, (line, *bands, *bursts, *chains))


def _robustness(result: RunResult) -> Section:
    """How robust rollouts are under the error model: expected, and in the worst hundredth."""
    title, found = "Robustness under the error model", result.robustness_tail
    if found is None:
        words = (
            "Not known: too few of the rollouts show what usually happens; plain rollouts "
            "(--method monte-carlo) do."
        )
        return Section("robustness", title, (), (_quiet(words),))
    # of a simulator of the user's own a result does not keep what its signals are measured in
    unit = "" if result.config.metric == "agm" or result.simulator is not None else " m"
    expected = f"{found.expected:.4g}{unit} +- {found.expected_std_error:.1g}"
    worst, quantile = "not known: too few were sampled", "not known"
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
    return Section("robustness", title, (Paragraph(line),), (doc.facts(rows),))


def _warnings(result: RunResult) -> Section:
    """What is wrong with the answer; in brief the gravest, and what else there is."""
    about_answer = [diagnostic.text for diagnostic in run_diagnostics(result)]
    if result.estimate is None:
        said = Paragraph("None so far; there is no estimate yet.")
        blocks = (said if result.message is None else Caution(result.message),)
        return Section("warnings", "Warnings", (), blocks)
    about_refits = () if result.pem_interval is None else result.pem_interval.warnings
    grave = (*about_answer, *answer_words.rule_warnings(result), *about_refits)
    shown = grave[: MOST_WARNINGS - 1]
    others = [text for text in data_warnings(result) if text not in about_refits]
    kinds = Counter(text.partition(":")[0] if ":" in text[:40] else "others" for text in others)
    kinds["more about the answer"] = len(grave) - len(shown)
    named = [f"{kind} ({count})" if count > 1 else kind for kind, count in kinds.items() if count]
    brief = [*shown, *([f"{', '.join(named)}; --verbose lists each"] if named else [])]
    full = tuple(map(Caution, about_answer))
    fine = (doc.Verdict("yes", "The diagnostics of the sampling give no warning."),)
    return Section("warnings", "Warnings", tuple(map(Caution, brief)), full or fine)


def _extrapolation(result: RunResult) -> Section | None:
    found = tuple(map(Caution, data_warnings(result)))
    if not found:
        return None
    title = "Extrapolated: where the error model has little or no data"
    return Section("extrapolation", title, (), found)


def _question(result: RunResult) -> Section:
    config = result.config
    ranked = f"{config.metric} robustness; whether one violates is decided by the formula itself"
    rows = [
        ("specification", doc.Verbatim(config.spec)),
        ("scenario", scenario_text(config)),
        ("error model", doc.Verbatim(result.pem.name)),
        ("method", f"{estimates.method_text(result)}, back end {config.simulator}"),
        ("budget", _budget_text(config)),
        ("rollouts are ranked by", ranked),
    ]
    if chosen := estimates.chosen_text(result):
        rows.insert(4, ("chosen, as", chosen))
    if learned := estimates.surrogate_text(result):
        rows.insert(4, ("before", learned))
    return Section("question", "What was requested", (), (doc.facts(rows),))


def _worst(result: RunResult) -> Section | None:
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
    return Section("worst", f"Worst rollout, {which}", (), (doc.facts(rows),))


def _provenance(result: RunResult) -> Section:
    status = result.status if result.message is None else f"{result.status}: {result.message}"
    timings = ", ".join(
        f"{part} {seconds:.2f} s" for part, seconds in result.timings_s.items() if part != "total"
    )
    total = f"{result.timings_s.get('total', math.nan):.1f} s"
    rows: list[tuple[str, str]] = [
        ("run", doc.Verbatim(result.run_id)),
        ("status", status),
        *_own_system_rows(result.simulator),
        ("perception error model", doc.Verbatim(result.pem.name)),
        ("its data", result.pem.data),
        ("its digest (SHA-256)", doc.Verbatim(result.pem.digest)),
        ("seed", str(result.config.seed)),
        ("versions", ", ".join(f"{name} {version}" for name, version in result.versions.items())),
        ("wall time", f"{total} ({timings})" if timings else total),
    ]
    if result.config.keep == "violations":
        kept = f"violations, and the {LEAST_ROBUST} least robust of each final stage; "
        kept += "learning stages whole, large ones in part"
        rows.append(("rollouts in its files", kept))
    return Section("provenance", "Provenance", (), (doc.facts(rows),))


def _own_system_rows(simulator: OwnSystem | None) -> list[tuple[str, str]]:
    if simulator is None:
        return []
    name, digest = simulator.name, simulator.source_digest
    steps = f"{simulator.states} states, one each {simulator.dt_s:.4g} s"
    package = "" if simulator.package is None else f" of {simulator.package}"
    rows = [("simulator", f"{name}: {steps}"), ("its code", f"{simulator.code}{package}")]
    return [*rows, ("its file's digest (SHA-256)", doc.Verbatim(digest))] if digest else rows


def _assumptions(result: RunResult) -> Section:
    return Section("assumptions", "Assumed", (), (doc.Bullets(result.assumptions),))


def _configuration(config: ExperimentConfig) -> Section:
    code = doc.Code(config_text(config), language="toml")
    return Section(
        "configuration", "Configuration", (), (doc.Folded("Complete configuration", (code,)),)
    )


def scenario_text(config: ExperimentConfig) -> str:
    """What differs from the defaults, the first figures in any case."""
    if not config.is_braking_scenario:
        return config.other_scenario
    scenario, default = config.scenario, ScenarioConfig()
    shown = (
        f"{scenario.initial_speed_kmh:g} km/h, {scenario.initial_gap_m:g} m behind a lead car "
        f"that brakes at {scenario.lead_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}"
    )
    named = {"initial_speed_kmh", "initial_gap_m", "lead_deceleration_mps2"}
    others = [
        f"{field.name} {value if isinstance(value, str) else f'{value:g}'}"
        for field in fields(scenario)
        if field.name not in named
        and (value := getattr(scenario, field.name)) != getattr(default, field.name)
    ]
    return "; ".join([shown, *others])


def _budget_text(config: ExperimentConfig) -> str:
    """What one repetition simulates, the method's other settings, and how many repetitions."""
    method = by_name(config.method)
    parts = [method.budget(config).words]
    for field in fields(config):
        # what was learned on a surrogate has a row of its own
        if field.name in method.settings - {"stages", "rollouts", "final_rollouts", "surrogate"}:
            value = getattr(config, field.name)
            if field.name == "alpha" and value is None:
                value = "chosen at each stage" if method.alpha is None else method.alpha
            elif value is None:
                value = "as the method has it"
            parts.append(f"{field.name} {value}")
    return ", ".join(parts + [f"{config.repetitions} repetitions"] * (config.repetitions > 1))
