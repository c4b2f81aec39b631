"""The sections of a safety case, of one run each."""

from collections.abc import Mapping, Sequence
from dataclasses import fields

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import config_text
from pemviz.pem import PemCard
from pemviz.reports.data_plan_text import (
    BAND_COLUMNS,
    BAND_NOTE,
    band_rows,
    plan_heading,
    plan_sentences,
    short_rows,
)
from pemviz.reports.estimate_text import (
    interval_name,
    interval_text,
    memory_text,
    occasion_text,
    short_probability,
)
from pemviz.reports.memory_curve import assumption_line
from pemviz.reports.pictures.data_plan import requirement_plot
from pemviz.reports.pictures.uncertainty import uncertainty_plot
from pemviz.reports.safety_case.case import CaseRun
from pemviz.reports.safety_case.claims import Claim, Verdict, claim_sentence, claims
from pemviz.reports.safety_case.html import (
    bullets,
    code_block,
    facts,
    html_table,
    pair,
    paragraph,
    table,
    warnings,
    words,
)
from pemviz.reports.uncertainty_text import ends_text
from pemviz.runs.result import RunResult
from pemviz.runs.trust import run_interval_caveats
from pemviz.runs.uncertainty import SourceKind, uncertainty_budget

VERDICT_MARKS: Mapping[Verdict, tuple[str, str]] = {
    "shown": ("yes", "\N{CHECK MARK} shown"),
    "not shown": ("no", "\N{BALLOT X} not shown"),
    "not known": ("open", "? not known"),
}
NOT_QUANTIFIED = "not told by this run"
UNTOLD = "Not quantified here; to be argued from elsewhere."


def headline(run: CaseRun, *, below: float | None) -> str:
    """How likely, how sure, resting on what, what next: all that a hurried reader sees."""
    result, estimate = run.result, run.result.estimate
    if estimate is None:
        return f"<div class='head'>{paragraph(claim_sentence(result, below=below))}</div>"
    caveats = run_interval_caveats(result)
    interval = interval_text(estimate, caveats=caveats)
    assumed, bursts = memory_text(result.memory), assumption_line(result.memory)
    left = (
        f"<p class='answer'>P(violation) = {words(short_probability(estimate))}</p>"
        + paragraph(
            f"in one {occasion_text(result.config)}, if error model {result.pem.name} is right, "
            f"and misses are {assumed}."
        )
        + paragraph(f"Sampling alone: {interval_name(estimate, caveats=caveats)} {interval}.")
        + warnings([f"Do not quote it: {against}." for against in caveats])
        + paragraph(claim_sentence(result, below=below))
    )
    under = warnings(() if bursts is None else (bursts,)) + _next(result)
    return f"<div class='head'>{pair(left, uncertainty_plot(result))}{under}</div>"


def _next(result: RunResult) -> str:
    rows = [f"{collect}: {then}" for collect, then in short_rows(result)]
    if result.plan is None or not rows:
        return ""
    return f"<p><b>{words(plan_heading(result.plan))}</b></p>{bullets(rows)}"


def claim_section(result: RunResult, *, below: float | None) -> str:
    """Claims by what they take for granted, each with its verdict."""
    found = claims(result, below=below)
    if not found:
        return paragraph(claim_sentence(result, below=below))
    rows = [_claim_row(claim) for claim in found]
    header = ("if", "the failure probability is below", "" if below is None else f"below {below:g}")
    return html_table(header, [row if below is not None else row[:2] for row in rows])


def _claim_row(claim: Claim) -> list[str]:
    bound = "not known" if claim.bound is None else f"{claim.bound:.2g}"
    note = f"<br><span class='quiet'>{words(claim.note)}</span>" if claim.note else ""
    verdict = "" if claim.verdict is None else verdict_mark(claim.verdict)
    granted = f"{words(claim.granted)}<br><span class='quiet'>{words(claim.name)}</span>"
    return [granted, f"{bound}{note}", verdict]


def verdict_mark(verdict: Verdict) -> str:
    """A verdict by sign, word and colour."""
    kind, mark = VERDICT_MARKS[verdict]
    return f"<span class='tag {kind}'>{mark}</span>"


def argument(result: RunResult) -> str:
    """Why the evidence carries the claim, step by step."""
    config, data = result.config, result.pem.data
    steps = [
        f"What may go wrong is stated exactly: a run violates {_asked(config)}, decided by the "
        "Boolean semantics of Signal Temporal Logic, strict comparisons as they are written.",
        f"The system is the scenario: {scenario_text(config)}. Everything but perception is "
        "deterministic in it (assumptions below).",
        f"Perception is the error model {result.pem.name}: how likely the detector misses, given "
        f"what it looks at, learnt from {data}. How far that may be wrong: E2, E5.",
        f"Violations are far too rare to wait for: method {config.method} draws rollouts in which "
        "they are common and weights each by how much likelier it is under the error model. "
        "Whether the weights can be trusted: E1.",
        "So the failure probability follows, if the error model is right (E1); how far it is open "
        "if it is not, source by source: E2. What causes violations, so that experts can judge "
        "whether the chains are plausible: E4.",
    ]
    return f"<ol>{''.join(f'<li>{words(step)}</li>' for step in steps)}</ol>"


def _asked(config: ExperimentConfig) -> str:
    rules = [f"{rule.name} {rule.formula!r}" for rule in config.rules]
    return f"one of the rules {'; '.join(rules)}" if rules else repr(config.spec)


def assumptions(result: RunResult) -> str:
    """Every assumption with what it is worth: how far the answer moves if it is given up."""
    rows = [_assumption_row(text, result) for text in result.assumptions]
    return table(("assumed", "what it is worth", "what would narrow it"), rows)


def _assumption_row(text: str, result: RunResult) -> tuple[str, str, str]:
    kinds: Sequence[SourceKind] = ()
    if text.startswith(("misses are independent", "given the state, misses hang")):
        kinds = ("memory",)
    elif "model holds where" in text:
        kinds = ("refits", "families", "data")
    sources = [source for source in uncertainty_budget(result) if source.kind in kinds]
    if not sources:
        return text, NOT_QUANTIFIED, UNTOLD
    worth = [
        f"{one.name}: {' to '.join(ends_text(one)) if one.high is not None else 'not looked at'}"
        for one in sources
    ]
    return (
        text,
        "; ".join(worth),
        "; ".join(dict.fromkeys(source.narrowed_by for source in sources)),
    )


def next_section(result: RunResult) -> str:
    """What to measure next: sentences, picture, table."""
    plan = result.plan
    if plan is None:
        return paragraph("This run made no plan: pemviz record --plan makes one.")
    parts = [bullets(plan_sentences(result))]
    if plan.labels is not None:
        parts.append(f"<div class='half'>{requirement_plot(plan.labels)}</div>")
        rows = band_rows(plan.labels)
        parts.append(table(BAND_COLUMNS, rows, numbers=range(len(BAND_COLUMNS))))
        parts.append(paragraph(BAND_NOTE, kind="quiet"))
    return "".join(parts)


def data_section(run: CaseRun) -> str:
    """The error model's card, and what it was trained on."""
    info, card = run.result.pem, run.card
    rows = [
        ("error model", info.name),
        ("trained on", info.data),
        ("digest (SHA-256)", info.digest),
    ]
    if card is None:
        note = "The model's card is not at hand here, or the model has changed since the run."
        return facts(rows) + paragraph(note, kind="quiet")
    return facts([*rows, *_card_rows(card)])


def _card_rows(card: PemCard) -> list[tuple[str, str]]:
    cells = card.support.get("cells", ())
    obstacles = sum(int(cell[-2]) for cell in cells)
    missed = sum(int(cell[-1]) for cell in cells)
    rows = [
        ("kind of model", card.model),
        ("training table (SHA-256)", card.data_digest or "not stated"),
        ("licence", card.licence),
        ("recipe", card.recipe),
        ("seed of its training", str(card.seed)),
        *((f"score: {name}", f"{value:.4f}") for name, value in card.scores.items()),
    ]
    if obstacles:
        share = f"{missed:,} of {obstacles:,} training obstacles ({missed / obstacles:.1%})"
        rows.append(("missed by the detector", share))
    return rows


def provenance(run: CaseRun) -> str:
    """Where the figures come from, and how to have them again."""
    result = run.result
    rows = [
        ("run", result.run_id),
        ("status", result.status if result.message is None else f"failed: {result.message}"),
        ("seed", str(result.config.seed)),
        ("versions", ", ".join(f"{name} {value}" for name, value in result.versions.items())),
        ("wall time", f"{result.timings_s.get('total', 0.0):.1f} s"),
        *((f"{name} (SHA-256)", digest) for name, digest in run.digests.items()),
    ]
    how = (
        "To have the same figures again: save the configuration below as config.toml, install "
        f"pemviz {result.versions.get('pemviz', 'in the same version')} with the versions above, "
        "and run"
    )
    return (
        facts(rows)
        + paragraph(how)
        + code_block("pemviz record --config config.toml")
        + code_block(config_text(result.config))
    )


def scenario_text(config: ExperimentConfig) -> str:
    """The scenario in a line, with what differs from the defaults."""
    if not config.is_braking_scenario:
        return config.other_scenario
    scenario, default = config.scenario, ScenarioConfig()
    shown = (
        f"an ego car {scenario.initial_gap_m:g} m behind a lead car, both at "
        f"{scenario.initial_speed_kmh:g} km/h; the lead car brakes at "
        f"{scenario.lead_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}"
    )
    named = {"initial_speed_kmh", "initial_gap_m", "lead_deceleration_mps2"}
    others = [
        f"{field.name} {value if isinstance(value, str) else f'{value:g}'}"
        for field in fields(scenario)
        if field.name not in named
        and (value := getattr(scenario, field.name)) != getattr(default, field.name)
    ]
    return "; ".join([shown, *others])
