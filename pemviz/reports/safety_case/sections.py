"""The sections of a safety case, of one run each: claim, argument, evidence, and what they rest on.

Evidence is what :mod:`pemviz.reports.run_document` tells of the run; what is here argues from it.
"""

from collections.abc import Iterator, Mapping, Sequence

from pemviz.config import ExperimentConfig
from pemviz.pem import PemCard
from pemviz.reports.charts import gap_chart, miss_chart
from pemviz.reports.document import (
    Block,
    Caution,
    Code,
    Document,
    Mark,
    Paragraph,
    Section,
    Table,
    Verbatim,
    Verdict,
    facts,
    figure,
)
from pemviz.reports.numbers import range_text
from pemviz.reports.run_words import scenario_text
from pemviz.reports.safety_case.case import CaseRun
from pemviz.reports.safety_case.claims import Claim, claim_sentence, claims
from pemviz.runs.result import RunResult
from pemviz.runs.trust import run_interval_caveats
from pemviz.runs.uncertainty import SourceKind, uncertainty_budget

MARKS: Mapping[str, Mark] = {"shown": "yes", "not shown": "no", "not known": "open"}
EVIDENCE = (
    (
        "The estimate and its diagnostics",
        ("answer", "rules", "rates", "diagnostics", "warnings", "models", "robustness"),
    ),
    ("How far the answer is open", ("uncertainty",)),
    ("Misses that follow each other", ("memory",)),
    ("What causes violations", ("causes", "starts", "worst")),
    ("The error model and its data", ("extrapolation",)),
)
"""Titles of what is numbered E1 to E5, and the sections of the run's document in each."""
NO_DATA_WARNING = "Nothing speaks against the error model where the scenario goes."


def head(run: CaseRun, document: Document, *, below: float | None) -> tuple[Block, ...]:
    """How likely, how sure, resting on what, what next: all that a hurried reader sees."""
    result = run.result
    claim = Paragraph(claim_sentence(result, below=below))
    if result.estimate is None:
        return (claim,)
    doubts = tuple(Caution(f"Do not quote it: {why}.") for why in run_interval_caveats(result))
    return (
        *document.blocks("answer", "given", brief=True),
        *doubts,
        claim,
        *(b for b in document.blocks("uncertainty", "memory", brief=True)),
        *(Paragraph(s.title, tone="strong") for s in document.choose(("plan",))),
        *document.blocks("plan", brief=True),
    )


def claim(result: RunResult, *, below: float | None) -> tuple[Block, ...]:
    """Claims by what they take for granted, each with its verdict."""
    found = claims(result, below=below)
    if not found:
        return (Paragraph(claim_sentence(result, below=below)),)
    columns = ("if", "by", "the failure probability is below", "why not, or what would tell")
    rows = [(one.granted, one.name, claim_bound(one), one.note) for one in found]
    if below is None:
        return (Table(columns, tuple(rows)),)
    judged = tuple((*row, claim_verdict(one)) for row, one in zip(rows, found, strict=True))
    return (Table((*columns, f"below {below:g}"), judged),)


def claim_bound(one: Claim) -> str:
    """Its upper bound."""
    return "not known" if one.bound is None else f"{one.bound:.2g}"


def claim_verdict(one: Claim) -> Verdict | str:
    """Whether it is shown; nothing where no claim was named."""
    return "" if one.verdict is None else Verdict(MARKS[one.verdict], one.verdict)


def argument(result: RunResult) -> tuple[str, ...]:
    """Why the evidence carries the claim, step by step."""
    config, data = result.config, result.pem.data
    return (
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
    )


def _asked(config: ExperimentConfig) -> str:
    rules = [f"{rule.name} {rule.formula!r}" for rule in config.rules]
    return f"one of the rules {'; '.join(rules)}" if rules else repr(config.spec)


def evidence(run: CaseRun, document: Document) -> Iterator[Section]:
    """Everything that speaks for or against the answer, numbered E1 to E5."""
    for number, (title, keys) in enumerate(EVIDENCE, start=1):
        blocks = [*document.blocks(*keys)]
        if number == 4:
            blocks[1:1] = _violations(run)
        blocks = blocks or [Paragraph(NO_DATA_WARNING)]
        yield Section(f"E{number}", f"E{number}. {title}", (), tuple(blocks))


def _violations(run: CaseRun) -> tuple[Block, ...]:
    """Gaps of the likeliest violations, and when misses that matter fall."""
    explanation, found, dt_s = run.result.explanation, run.violations, run.result.config.dt_s
    over_time = () if explanation is None else explanation.miss_probability_by_step
    gaps = None if found is None else gap_chart(found.gap_m, found.missed, found.share, dt_s=dt_s)
    return (*figure(gaps), *figure(miss_chart(over_time, dt_s=dt_s) if any(over_time) else None))


def assumptions(result: RunResult) -> Table:
    """Every assumption with what it is worth: how far the answer moves if it is given up."""
    rows = tuple(_assumption_row(text, result) for text in result.assumptions)
    return Table(("assumed", "what it is worth", "what would narrow it"), rows)


def _assumption_row(text: str, result: RunResult) -> tuple[str, str, str]:
    kinds: Sequence[SourceKind] = ()
    if text.startswith(("misses are independent", "given the state, misses hang")):
        kinds = ("memory",)
    elif "model holds where" in text:
        kinds = ("refits", "model-classes", "data")
    sources = [source for source in uncertainty_budget(result) if source.kind in kinds]
    if not sources:
        return text, "not told by this run", "Not quantified here; to be argued from elsewhere."
    worth = [
        f"{one.name}: {range_text(one.low, one.high) if one.high is not None else 'not looked at'}"
        for one in sources
    ]
    narrowed = dict.fromkeys(source.narrowed_by for source in sources)
    return text, "; ".join(worth), "; ".join(narrowed)


def data_and_model(run: CaseRun) -> tuple[Block, ...]:
    """The error model's card, and what it was trained on."""
    info, card = run.result.pem, run.card
    rows = [
        ("error model", info.name),
        ("trained on", info.data),
        ("digest (SHA-256)", Verbatim(info.digest)),
    ]
    if card is None:
        note = "The model's card is not at hand here, or the model has changed since the run."
        return facts(rows), Paragraph(note, tone="quiet")
    return (facts([*rows, *_card_rows(card)]),)


def _card_rows(card: PemCard) -> list[tuple[str, str]]:
    cells = card.support.get("cells", ())
    obstacles = sum(int(cell[-2]) for cell in cells)
    missed = sum(int(cell[-1]) for cell in cells)
    rows = [
        ("kind of model", card.model),
        ("training table (SHA-256)", Verbatim(card.data_digest or "not stated")),
        ("licence", card.licence),
        ("recipe", card.recipe),
        ("seed of its training", str(card.seed)),
        *((f"score: {name}", f"{value:.4f}") for name, value in card.scores.items()),
    ]
    if obstacles:
        share = f"{missed:,} of {obstacles:,} training obstacles ({missed / obstacles:.1%})"
        rows.append(("missed by the detector", share))
    return rows


def reproduce(run: CaseRun, document: Document) -> tuple[Block, ...]:
    """Where the figures come from, and how to have them again."""
    digests = tuple((f"{name} (SHA-256)", Verbatim(v)) for name, v in run.digests.items())
    version = run.result.versions.get("pemviz", "in the same version")
    how = (
        "To have the same figures again: save the configuration below as config.toml, install "
        f"pemviz {version} with the versions above, and run"
    )
    return (
        *document.blocks("provenance"),
        *((facts(digests),) if digests else ()),
        Paragraph(how),
        Code("pemviz record --config config.toml"),
        *document.blocks("configuration"),
    )
