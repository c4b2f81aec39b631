"""The evidence of one run: figures and pictures, each with what it shows."""

from pemviz.colors import BLACK, BLUE, GREEN, ORANGE, VERMILLION
from pemviz.reports.causes_text import BURST_TITLE, burst_rows, causes_line
from pemviz.reports.estimate_text import (
    interval_name,
    interval_text,
    number_text,
    probability_text,
    reference_text,
    share_text,
    violations_text,
)
from pemviz.reports.pictures.answers import AnswerRow, answers_plot
from pemviz.reports.pictures.causes import band_table, chain_table
from pemviz.reports.pictures.memory import memory_curves
from pemviz.reports.pictures.starts import start_plane
from pemviz.reports.pictures.uncertainty import uncertainty_plot
from pemviz.reports.pictures.violations import gap_plot, misses_over_time
from pemviz.reports.rates_text import rate_columns, rate_line, rate_rows
from pemviz.reports.rules_text import RULE_COLUMNS, RULES_TITLE, rule_rows, rule_warnings
from pemviz.reports.safety_case.case import CaseRun
from pemviz.reports.safety_case.html import (
    bullets,
    facts,
    figure,
    pair,
    paragraph,
    table,
    warnings,
    words,
)
from pemviz.reports.starts_text import (
    START_COLUMNS,
    STARTS_TITLE,
    map_words,
    start_rows,
    starts_line,
    starts_title,
)
from pemviz.reports.uncertainty_text import UNCERTAINTY_TITLE, source_name
from pemviz.runs.result import RunResult
from pemviz.runs.trust import data_warnings, run_diagnostics, run_interval_caveats
from pemviz.runs.uncertainty import uncertainty_budget
from pemviz.sampling.estimates.meanings import RELIABLE_PARETO_K, SMALL_ESS
from pemviz.types import Estimate

MOST_REPETITIONS = 10


def evidence(run: CaseRun, *, below: float | None) -> str:
    """Everything that speaks for or against the answer, numbered E1 to E5."""
    result = run.result
    sections = (
        ("The estimate and its diagnostics", _estimate(result, below=below)),
        (UNCERTAINTY_TITLE, _uncertainty(result)),
        ("Misses that follow each other", _memory(result)),
        ("What causes violations", _causes(run)),
        ("The error model and its data", _data(result)),
    )
    return "".join(
        f"<h3>E{number}. {words(title)}</h3>{body}"
        for number, (title, body) in enumerate(sections, start=1)
    )


def _estimate(result: RunResult, *, below: float | None) -> str:
    estimate = result.estimate
    if estimate is None:
        return paragraph(f"There is none: the run {result.status}.")
    rows = [
        ("probability of a violation", probability_text(estimate), ""),
        _interval_row(result, estimate),
        ("violations", violations_text(estimate), "at least ten"),
    ]
    if estimate.ess is not None:
        ess, tail = number_text(estimate.ess), number_text(estimate.pareto_k)
        rows += [
            ("effective sample size", ess, f"{SMALL_ESS:g} or more"),
            ("Pareto k-hat", tail, f"{RELIABLE_PARETO_K:g} or less"),
            ("largest weight's share", share_text(estimate.max_weight_share), "a few per cent"),
        ]
    if result.reference is not None:
        rows.append(
            ("exact reference", reference_text(result.reference, estimate), "inside the interval")
        )
    about_answer = [diagnostic.text for diagnostic in run_diagnostics(result)]
    told = warnings(about_answer) if about_answer else paragraph(NO_WARNING)
    picture = answers_plot(answer_rows(result), title="Answers", limit=below)
    caption = "The answer beside others to the same question; bars are their ranges"
    caption += "" if below is None else f", the dashed line is {below:g}"
    return (
        table(("figure", "found", "wanted"), rows)
        + told
        + _rules(result)
        + _rates(result)
        + f"<div class='half wide'>{figure(picture, f'{caption}.')}</div>"
    )


def _rules(result: RunResult) -> str:
    """Each rule's answer, where there are several."""
    if not result.rules:
        return ""
    words = paragraph(f"{RULES_TITLE}; the figures above are of any of them being broken.")
    return words + table(RULE_COLUMNS, rule_rows(result)) + warnings(rule_warnings(result))


def _rates(result: RunResult) -> str:
    """Violations an hour or a kilometre of driving, where either is told."""
    rows = rate_rows(result)
    return paragraph(rate_line(result)) + table(rate_columns(result), rows) if rows else ""


NO_WARNING = "The diagnostics of the sampling give no warning."


def _interval_row(result: RunResult, estimate: Estimate) -> tuple[str, str, str]:
    caveats = run_interval_caveats(result)
    return (
        interval_name(estimate, caveats=caveats),
        interval_text(estimate, caveats=caveats),
        "no caveat",
    )


def answer_rows(result: RunResult) -> list[AnswerRow]:
    """The answer, its repetitions, the reference, and what other models say."""
    estimate = result.estimate
    if estimate is None:
        return []
    holds = not run_interval_caveats(result)
    rows = [
        AnswerRow(
            f"this run, {estimate.method}",
            estimate.probability,
            estimate.ci_low,
            estimate.ci_high,
            BLUE,
            holds=holds,
        )
    ]
    if len(result.repetitions) > 1:
        rows += [
            AnswerRow(f"repetition {i + 1}", one.probability, one.ci_low, one.ci_high, BLUE)
            for i, one in enumerate(result.repetitions[:MOST_REPETITIONS])
        ]
    if result.reference is not None:
        exact = result.reference.probability
        rows.append(AnswerRow("exact reference", exact, None, None, GREEN))
    models = result.pem_interval
    if models is not None:
        name = f"median of {models.members} refits"
        rows.append(AnswerRow(name, models.median, models.low or 0.0, models.high, ORANGE))
    for family in sorted(result.families, key=lambda one: one.log10_probability):
        rough = "" if family.is_reliable else ", roughly"
        name = f"error model {family.name}{rough}"
        rows.append(AnswerRow(name, family.probability, None, None, VERMILLION))
    if result.data_bound is not None:
        bound = result.data_bound.probability
        rows.append(AnswerRow("data alone, upper bound", bound, None, None, BLACK))
    return rows


def _uncertainty(result: RunResult) -> str:
    caption = (
        "Each bar is one source of doubt; they are not added up, as each takes for granted what "
        "the others doubt."
    )
    rows = [(source_name(source), source.narrowed_by) for source in uncertainty_budget(result)]
    if not rows:
        return paragraph("Without an estimate nothing bounds it.")
    return pair(
        figure(uncertainty_plot(result), caption), table(("left open by", "narrowed by"), rows)
    )


def _data(result: RunResult) -> str:
    """Where the error model goes beyond its data, in one box."""
    found = data_warnings(result)
    return f"<div class='warn'>{bullets(found)}</div>" if found else paragraph(NO_DATA_WARNING)


NO_DATA_WARNING = "Nothing speaks against the error model where the scenario goes."


def _memory(result: RunResult) -> str:
    """What independence of misses is worth, where it was asked; otherwise that it was not."""
    over_time, over_frailty = memory_curves(result.memory)
    if not over_time:
        return warnings(
            [
                "What the assumption on how misses follow each other is worth was not looked at "
                "in this run: pemviz record --memory-curve tells. On video misses come in bursts."
            ]
        )
    return pair(over_time, over_frailty)


def _causes(run: CaseRun) -> str:
    explanation, config = run.result.explanation, run.result.config
    if explanation is None:
        none = "No weighted violation was seen that tells where misses matter."
        return paragraph(none) + _starts(run.result)
    dt_s = config.dt_s
    found = run.violations
    gaps = "" if found is None else gap_plot(found.gap_m, found.missed, found.share, dt_s=dt_s)
    over_time = explanation.miss_probability_by_step
    times = misses_over_time(over_time, dt_s=dt_s) if any(over_time) else ""
    parts = [paragraph(f"{causes_line(explanation)}."), pair(gaps, times), _starts(run.result)]
    if explanation.misses_by_distance:
        parts.append(band_table(explanation, target=config.target))
        parts.append(paragraph(SENSITIVITY, kind="quiet"))
    rows = burst_rows(explanation, target=config.target)
    if rows:
        parts += [f"<h4>{words(BURST_TITLE)}</h4>", facts(rows)]
    if any(chain.missed_steps for chain in explanation.chains):
        caption = "The likeliest chains of misses that matter, each with its share."
        chains = figure(chain_table(explanation.chains, dt_s=dt_s), caption)
        parts.append(f"<div class='half'>{chains}</div>")
    return "".join(parts)


def _starts(result: RunResult) -> str:
    """Which starts are dangerous, where the simulator names them."""
    parts = [f"<h4>{words(STARTS_TITLE)}</h4>"] if result.starts else []
    for found in result.starts:
        parts += [paragraph(f"{starts_title(found)}. {starts_line(found)}.")]
        parts.append(table(START_COLUMNS, start_rows(found)))
        parts.append(f"<div class='half wide'>{figure(start_plane(found), map_words(found))}</div>")
    return "".join(parts)


SENSITIVITY = (
    "Sensitivity: one per cent fewer misses in a band bring about so many per cent fewer "
    "violations."
)
