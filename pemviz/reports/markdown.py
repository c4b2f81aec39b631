"""A run as one page of markdown, suited to the summary page of a pipeline's job."""

import math
from collections.abc import Sequence
from dataclasses import fields

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import config_text
from pemviz.reports.causes_text import BURST_COLUMNS, BURST_TITLE, burst_rows, causes_line
from pemviz.reports.data_plan_text import (
    BAND_COLUMNS,
    BAND_NOTE,
    PLAN_TITLE,
    band_rows,
    plan_sentences,
)
from pemviz.reports.escape import markdown_block, markdown_code, markdown_table, markdown_text
from pemviz.reports.estimate_text import (
    RELIABLE_TAIL,
    interval_name,
    interval_text,
    memory_text,
    model_range_text,
    number_text,
    probability_text,
    reference_text,
    share_text,
    short_probability,
    violations_text,
)
from pemviz.reports.gate import GateDecision
from pemviz.reports.interval_plot import IntervalRow, interval_plot
from pemviz.reports.memory_curve import CURVE_AXES, assumption_lines, curve_columns, curve_rows
from pemviz.reports.rates_text import rates_markdown
from pemviz.reports.rules_text import RULE_COLUMNS, RULES_TITLE, rule_rows, rule_warnings
from pemviz.reports.starts_text import starts_markdown
from pemviz.reports.uncertainty_text import UNCERTAINTY_COLUMNS, UNCERTAINTY_TITLE, uncertainty_rows
from pemviz.runs.result import LEAST_ROBUST, RunResult
from pemviz.runs.trust import data_warnings, run_diagnostics, run_interval_caveats
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

MOST_REPETITIONS = 20
BUDGET_FIELDS = frozenset({"stages", "rollouts", "final_rollouts"})
DOTTED = "dotted is not a 95 % interval (the table and the warnings say why)"
GATE_MARKS = {"passed": "✅", "tripped": "❌", "undecided": "⚠️"}

Row = tuple[str, str]


def summary_markdown(result: RunResult, *, gate: GateDecision | None = None) -> str:
    """The answer, a plot of its interval, the worst rollout, warnings and provenance.

    Args:
        result: The run.
        gate: The gate's decision, if there is a gate.
    """
    parts = [f"## pemviz: {_headline(result)}", *_status(result, gate)]
    if result.estimate is not None:
        parts += [*_memory(result), _answer(result, result.estimate), *_rules(result)]
        parts += rates_markdown(result, level="###")
        parts += _plot(result, gate)
        parts += [*_uncertainty(result), *_plan(result), *_causes(result)]
        parts += starts_markdown(result, level="###")
    parts += [*_warnings(result), *_worst(result), *_provenance(result), _assumptions(result)]
    parts.append(_details("Complete configuration", _config(result.config)))
    return "\n\n".join(parts) + "\n"


def _headline(result: RunResult) -> str:
    if result.estimate is None:
        return f"no estimate, the run {result.status}"
    return f"failure probability {short_probability(result.estimate)}"


def _status(result: RunResult, gate: GateDecision | None) -> list[str]:
    lines: list[str] = []
    if gate is not None:
        sentence = markdown_text(f"Gate {gate.sentence}")
        lines.append(f"{GATE_MARKS[gate.outcome]} **{sentence}**")
    if result.status != "done":
        message = "" if result.message is None else f": {markdown_text(result.message)}"
        lines.append(f"⚠️ **The run {result.status}{message}.** The figures are of what was done.")
    lines.append(f"Specification: {markdown_code(result.config.spec)}")
    return lines


def _answer(result: RunResult, estimate: Estimate) -> str:
    caveats = run_interval_caveats(result)
    interval = interval_text(estimate, caveats=caveats)
    rows: list[Row] = [
        ("probability of a violation", f"**{probability_text(estimate)}**"),
        ("log10", number_text(estimate.log10_probability)),
        (interval_name(estimate, caveats=caveats), markdown_text(interval)),
        ("misses", memory_text(result.memory)),
        ("range over refits", model_range_text(result.pem_interval)),
        *_beside(result, estimate),
        ("violations", violations_text(estimate)),
        ("NLL of violations", number_text(estimate.nll_mean, unit="nats (mean)")),
    ]
    if by_name(estimate.method).rests_on_weights:
        rows += [
            ("effective sample size", number_text(estimate.ess)),
            ("Pareto k-hat", number_text(estimate.pareto_k, unit=RELIABLE_TAIL)),
            ("largest weight's share", share_text(estimate.max_weight_share)),
        ]
    return markdown_table(("answer", ""), rows)


def _rules(result: RunResult) -> list[str]:
    """Each rule's answer, and what is wrong with it."""
    if not result.rules:
        return []
    rows = [tuple(map(markdown_text, row)) for row in rule_rows(result)]
    lines = [f"- ⚠️ {markdown_text(text)}" for text in rule_warnings(result)]
    return [
        f"**{RULES_TITLE}**; the answer above is that any of them is broken.",
        markdown_table(RULE_COLUMNS, rows),
        *(["\n".join(lines)] if lines else []),
    ]


def _memory(result: RunResult) -> list[str]:
    """What the assumptions on misses are worth, first of all, and the curves."""
    memory = result.memory
    if memory is None:
        return []
    parts = [f"**{markdown_text(line)}**" for line in assumption_lines(memory)]
    for axis in CURVE_AXES:
        rows = [
            (row.place, row.probability, row.interval, row.measured)
            for row in curve_rows(memory, axis)
        ]
        if rows:
            parts += [markdown_table(curve_columns(memory, axis), rows), axis.note]
    return parts


def _beside(result: RunResult, estimate: Estimate) -> list[Row]:
    """What else is known of the probability, if it is."""
    rows: list[Row] = []
    if result.reference is not None:
        rows.append(("reference", reference_text(result.reference, estimate)))
    if result.data_bound is not None:
        bound = result.data_bound
        words = f"below {bound.probability:.2g} (confidence {bound.confidence:.0%})"
        rows.append(("by the error model's data alone", words))
    return rows


def _plot(result: RunResult, gate: GateDecision | None) -> list[str]:
    rows = interval_rows(result, limit=None if gate is None else gate.limit)
    plot = interval_plot(rows)
    if not plot:
        return []
    dotted = "" if all(row.holds for row in rows) else f"; {DOTTED}"
    words = f"Probability with its interval, logarithmic axis{dotted}:"
    return [words, markdown_block(plot)]


def interval_rows(result: RunResult, *, limit: float | None) -> list[IntervalRow]:
    """The rows of the interval plot: the estimate, the repetitions, the gate's limit."""
    if result.estimate is None:
        return []
    repetitions = result.repetitions if len(result.repetitions) > 1 else ()
    shown = repetitions[:MOST_REPETITIONS]
    rows = [
        _row(f"repetition {number + 1}", one, caveats=interval_caveats(one))
        for number, one in enumerate(shown)
    ]
    name = result.estimate.method if not repetitions else f"mean of {len(repetitions)}"
    rows.append(_row(name, result.estimate, caveats=run_interval_caveats(result)))
    models = result.pem_interval
    if models is not None and models.high is not None:
        rows.append(IntervalRow("refits", models.median, models.low or 0.0, models.high))
    if result.reference is not None:
        rows.append(IntervalRow("reference", result.reference.probability, mark="*"))
    if limit is not None:
        rows.append(IntervalRow("gate", limit, mark="X"))
    return rows


def _row(label: str, estimate: Estimate, *, caveats: Sequence[str]) -> IntervalRow:
    ends = (estimate.ci_low, estimate.ci_high)
    return IntervalRow(label, estimate.probability, *ends, holds=not caveats)


def _uncertainty(result: RunResult) -> list[str]:
    rows = [tuple(map(markdown_text, row)) for row in uncertainty_rows(result)]
    return [f"### {UNCERTAINTY_TITLE}", markdown_table(UNCERTAINTY_COLUMNS, rows)]


def _plan(result: RunResult) -> list[str]:
    """What to measure next, if it was asked for."""
    plan = result.plan
    if plan is None:
        return []
    sentences = "\n".join(f"- {markdown_text(words)}" for words in plan_sentences(result))
    parts = [f"### {PLAN_TITLE}", sentences]
    if plan.labels is not None:
        rows = [tuple(map(markdown_text, row)) for row in band_rows(plan.labels)]
        parts += [markdown_table(BAND_COLUMNS, rows), markdown_text(BAND_NOTE)]
    return parts


def _causes(result: RunResult) -> list[str]:
    """Where misses lie before a violation, and how they hang together."""
    explanation = result.explanation
    if explanation is None:
        return []
    parts = ["### Misses that cause it", causes_line(explanation)]
    rows = burst_rows(explanation, target=result.config.target)
    return [*parts, f"{BURST_TITLE}.", markdown_table(BURST_COLUMNS, rows)] if rows else parts


def _warnings(result: RunResult) -> list[str]:
    about_answer = [diagnostic.text for diagnostic in run_diagnostics(result)]
    about_data = data_warnings(result)
    sections: list[str] = []
    if about_answer:
        sections += ["### Warnings", _list(about_answer)]
    if about_data:
        sections += [
            "### Extrapolated: where the error model has little or no data",
            _list(about_data),
        ]
    return sections


def _list(warnings: Sequence[str]) -> str:
    return "\n".join(f"- ⚠️ {markdown_text(warning)}" for warning in warnings)


def _worst(result: RunResult) -> list[str]:
    if not result.least_robust:
        return []
    worst = result.least_robust[0]
    rows: list[Row] = [
        ("robustness", f"{worst.robustness:.3g} ({result.config.metric})"),
        ("verdict", "violates" if worst.violated else "holds"),
        ("missed detections", _misses(result.config, worst.misses)),
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
    return ["### Worst rollout", markdown_table((which, ""), rows)]


def _provenance(result: RunResult) -> list[str]:
    config = result.config
    rows: list[Row] = [
        ("run", markdown_code(result.run_id)),
        ("perception error model", markdown_code(result.pem.name)),
        ("its data", markdown_text(result.pem.data)),
        ("its digest (SHA-256)", markdown_code(result.pem.digest)),
        ("method", f"{config.method}, metric {config.metric}, back end {config.simulator}"),
        ("budget", _budget(config)),
        ("scenario", _scenario(config)),
        ("seed", str(config.seed)),
        ("versions", markdown_text(", ".join(f"{n} {v}" for n, v in result.versions.items()))),
        ("wall time", f"{result.timings_s.get('total', math.nan):.1f} s"),
    ]
    if config.keep == "violations":
        kept = f"violations, and the {LEAST_ROBUST} least robust of each final stage"
        kept += "; learning stages whole, large ones in part"
        rows.insert(-2, ("rollouts in its files", kept))
    return ["### Provenance", markdown_table(("what", "value"), rows)]


def _budget(config: ExperimentConfig) -> str:
    """What one repetition simulates, the method's other settings, and how many repetitions."""
    method = by_name(config.method)
    settings = [
        f"{field.name} {_setting(config, field.name, method)}"
        for field in fields(config)
        if field.name in method.settings - BUDGET_FIELDS
    ]
    repetitions = [f"{config.repetitions} repetitions"] if config.repetitions > 1 else []
    return markdown_text(", ".join([method.budget(config).words, *settings, *repetitions]))


def _setting(config: ExperimentConfig, name: str, method: MethodDescription) -> object:
    value = getattr(config, name)
    if name == "alpha" and value is None:
        return "chosen at each stage" if method.alpha is None else method.alpha
    return value


def _misses(config: ExperimentConfig, misses: int) -> str:
    if not config.is_braking_scenario:  # its rollouts may be of another length
        return str(misses)
    return f"{misses} of {config.scenario.states - 1} steps"


def _scenario(config: ExperimentConfig) -> str:
    """What differs from the defaults, the first figures in any case."""
    if not config.is_braking_scenario:
        return markdown_text(config.other_scenario)
    scenario, default = config.scenario, ScenarioConfig()
    shown = (
        f"{scenario.initial_speed_kmh:g} km/h, {scenario.initial_gap_m:g} m behind a lead car "
        f"that brakes at {scenario.lead_deceleration_mps2:g} m/s²"
    )
    named = {"initial_speed_kmh", "initial_gap_m", "lead_deceleration_mps2"}
    others = [
        f"{field.name} {value if isinstance(value, str) else f'{value:g}'}"
        for field in fields(scenario)
        if field.name not in named
        and (value := getattr(scenario, field.name)) != getattr(default, field.name)
    ]
    return markdown_text("; ".join([shown, *others]))


def _assumptions(result: RunResult) -> str:
    items = "\n".join(f"- {markdown_text(assumption)}" for assumption in result.assumptions)
    return f"### Assumed\n\n{items}"


def _config(config: ExperimentConfig) -> str:
    return markdown_block(config_text(config), language="toml")


def _details(title: str, body: str) -> str:
    return f"<details><summary>{title}</summary>\n\n{body}\n\n</details>"
