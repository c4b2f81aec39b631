"""The argument of a safety case as data: goals, strategies, solutions, what they stand in.

The words are those of the Goal Structuring Notation (Community Standard, version 3). A claim that
does not hold is an undeveloped goal. What a solution names is a file by its digest.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from pemviz.files.atomic import file_digest
from pemviz.reports.budget_document import (
    FACTORS,
    METHOD,
    harm_source,
    verdict_sentence,
    violation_source,
)
from pemviz.reports.case_runs import ROLLOUTS, CaseRun
from pemviz.reports.estimate_words import end_text
from pemviz.reports.run_document import scenario_text
from pemviz.reports.safety_claims import claimed, claims
from pemviz.runs.result import RunResult
from pemviz.runs.result_file import RESULT_FILE
from pemviz.runs.risk_budget import JudgedBudget, JudgedHazard

ElementKind = Literal["Goal", "Strategy", "Solution", "Context", "Assumption", "Justification"]
PREFIXES: Mapping[str, ElementKind] = {
    "G": "Goal",
    "Sn": "Solution",
    "S": "Strategy",
    "C": "Context",
    "A": "Assumption",
    "J": "Justification",
}
"""How names begin; Sn before S."""
TOP = "G-top"
CLAIM, FILE, DIGEST = "claim", "file", "sha256"
BUDGET, RUN, BELOW = "budget", "run", "claim_below"
"""What an element carries beside what the notation knows."""


@dataclass(frozen=True)
class Element:
    """One element.

    Attributes:
        name: Begins with the prefix of its kind and a dash.
        text: What it says.
        supported_by: Names of goals, strategies and solutions; none of an undeveloped goal.
        in_context_of: Names of contexts, assumptions and justifications.
        undeveloped: Whether it is a claim that does not hold.
        details: For programs: of a claim ``claim``, of a solution ``file`` and ``sha256``, of the
            top goal what it was made from.
    """

    name: str
    text: str
    supported_by: tuple[str, ...] = ()
    in_context_of: tuple[str, ...] = ()
    undeveloped: bool = False
    details: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def kind(self) -> ElementKind:
        """By its name; what begins otherwise is somebody's own and taken for a context."""
        for prefix, kind in PREFIXES.items():
            if self.name.startswith(prefix):
                return kind
        return "Context"


Argument = tuple[Element, ...]
"""Elements, the top goal first."""


def undeveloped(argument: Argument, goals: Collection[str]) -> Argument:
    """The same with these goals undeveloped, without what nothing names any more."""
    changed = {
        one.name: replace(one, undeveloped=True, supported_by=()) if one.name in goals else one
        for one in argument
    }
    reached = dict[str, None]()
    waiting = [argument[0].name] if argument else []
    while waiting:
        name = waiting.pop()
        if name in changed and name not in reached:
            reached[name] = None
            waiting += [*changed[name].supported_by, *changed[name].in_context_of]
    return tuple(one for name, one in changed.items() if name in reached)


def argument_of_runs(runs: Sequence[CaseRun], *, below: float | None) -> Argument:
    """One run's claims, or those of several below one goal."""
    parts = [_of_run(run, f"run{place}", below) for place, run in enumerate(runs, start=1)]
    made_from = {f"{RUN}{place}": str(run.folder) for place, run in enumerate(runs, start=1)}
    if below is not None:
        made_from[BELOW] = repr(below)
    if len(parts) == 1:
        first, *others = parts[0]
        top = replace(first, name=TOP, details={**first.details, **made_from})
        return _finished((top, *others))
    bound = "is as rare as its own goal says" if below is None else f"is below {below:g}"
    top = Element(
        TOP,
        f"In each of {len(parts)} runs the probability of a violation {bound}",
        supported_by=("S-runs",),
        details=made_from,
    )
    each = Element("S-runs", "Each run by itself", tuple(part[0].name for part in parts))
    return _finished((top, each, *(one for part in parts for one in part)))


def argument_of_budget(judged: JudgedBudget) -> Argument:
    """The accepted rate of harm, hazard by hazard."""
    accepted = judged.budget.accepted_harm_per_hour
    hazards = [_of_hazard(one, place, judged) for place, one in enumerate(judged.hazards, start=1)]
    budget = Element(
        "Sn-budget",
        f"Risk budget {judged.path.name}: every factor with its interval and source",
        details={FILE: str(judged.path), DIGEST: judged.digest},
    )
    of_runs = dict.fromkeys(name for one in hazards for name in _solutions(one) if "-run" in name)
    total = Element(
        "G-sum",
        f"All hazards together, {verdict_sentence(judged)}",
        supported_by=(budget.name, *of_runs) if judged.outcome == "met" else (),
        undeveloped=judged.outcome != "met",
        details={CLAIM: "sum"},
    )
    top = Element(
        TOP,
        f"{judged.budget.name}: harm is caused at most {end_text(accepted)} times an hour",
        supported_by=("S-hazards",),
        in_context_of=("C-accepted",),
        details={BUDGET: str(judged.path)},
    )
    strategy = Element(
        "S-hazards",
        "Over hazards: their rates of harm add up",
        supported_by=(total.name, *(one[0].name for one in hazards)),
        in_context_of=("J-method", *(f"A-{n}" for n, _ in enumerate(judged.cautions, start=1))),
    )
    around = (
        Element("C-accepted", f"Accepted by: {judged.budget.source}"),
        Element("J-method", METHOD[0]),
        *(Element(f"A-{n}", text) for n, text in enumerate(judged.cautions, start=1)),
    )
    parts = (one for hazard in hazards for one in hazard)
    return _finished((top, strategy, total, *parts, budget, *around))


def _finished(argument: Argument) -> Argument:
    """Each element once."""
    return tuple({one.name: one for one in argument}.values())


def _solutions(argument: Sequence[Element]) -> Iterator[str]:
    return (one.name for one in argument if one.kind == "Solution")


def _of_run(run: CaseRun, key: str, below: float | None) -> Argument:
    """A run's claims: one for each source of uncertainty, under what that takes for granted."""
    result = run.result
    around = (
        Element(f"C-{key}-system", f"Scenario: {scenario_text(result.config)}"),
        Element(f"C-{key}-rules", f"Violation: {_rules(result)}"),
        Element(f"C-{key}-model", _model(result)),
        *_assumptions(result, key),
    )
    files = _files(key, {name: run.folder / name for name in run.digests}, run.digests)
    found = claims(result, below=below)
    goals = list[Element]()
    for one in found:
        doubted = bool(one.note) or one.bound is None
        holds = not doubted if one.verdict is None else one.verdict == "shown"
        least = one.bound_text if below is None else f"{below:g}"
        known = f"known: below {one.bound_text}" if one.bound is not None else one.note
        says = "" if below is None and one.bound is not None else f" ({known})"
        support = tuple(
            file.name for file in files if one.kind == "sampling" or file.name.endswith("result")
        )
        goals.append(
            Element(
                f"G-{key}-{one.kind}",
                f"The probability is below {least} if {one.granted}{says}",
                supported_by=support if holds else (),
                undeveloped=not (holds and support),
                details={CLAIM: one.kind},
            )
        )
    bounds = [one.bound for one in found if one.bound is not None]
    highest = end_text(max(bounds)) if bounds and below is None else None
    limit = f"{below:g}" if below is not None else highest
    limit = "what is known" if limit is None else limit
    top = Element(
        f"G-{key}",
        f"Run {run.name}: {claimed(result)} with a probability below {limit}",
        supported_by=(f"S-{key}",) if goals else (),
        in_context_of=tuple(one.name for one in around),
        undeveloped=not goals,
        details={} if goals else {CLAIM: "estimate"},
    )
    strategy = Element(
        f"S-{key}",
        "Over all that leaves the answer open: each source takes for granted what others doubt",
        supported_by=tuple(one.name for one in goals),
    )
    held = {name for one in goals for name in one.supported_by}
    return (
        top,
        *((strategy,) if goals else ()),
        *goals,
        *(one for one in files if one.name in held),
        *around,
    )


def _rules(result: RunResult) -> str:
    rules = "; ".join(f"not {rule.formula} ({rule.name})" for rule in result.config.rules)
    return rules or f"not {result.config.spec}"


def _model(result: RunResult) -> str:
    if result.is_of_detector_itself:
        return "The detector itself, on images as the simulator renders them; no error model"
    return f"Error model {result.pem.name} (SHA-256 {result.pem.digest[:16]}), by {result.pem.data}"


def _assumptions(result: RunResult, key: str) -> Argument:
    return tuple(
        Element(f"A-{key}-{place}", text) for place, text in enumerate(result.assumptions, start=1)
    )


def _files(key: str, paths: Mapping[str, Path], digests: Mapping[str, str]) -> Argument:
    """Solutions: what a run says, and the rollouts that it rests on."""
    named = {RESULT_FILE: ("result", "estimates"), ROLLOUTS: ("rollouts", "rollouts")}
    return tuple(
        Element(
            f"Sn-{key}-{short}",
            f"{what.capitalize()} of run {paths[name].resolve().parent.name}: {name}",
            details={FILE: str(paths[name]), DIGEST: digests[name]},
        )
        for name, (short, what) in named.items()
        if name in digests
    )


def _of_hazard(one: JudgedHazard, place: int, judged: JudgedBudget) -> Argument:
    """A hazard's rate of harm as the product of three factors, a goal each."""
    hazard, key = one.hazard, f"h{place}"
    risks = () if judged.risk is None else judged.risk.hazards
    risk = next((found for found in risks if found.name == hazard.name), None)
    stated = ("Sn-budget",)
    encounters = _factor(
        f"G-{key}-encounters",
        FACTORS["encounters"],
        None if risk is None else risk.encounters_per_hour.high,
        hazard.encounters.source,
        stated,
    )
    harm = _factor(
        f"G-{key}-harm",
        FACTORS["harm"],
        None if risk is None else risk.harm.high,
        harm_source(one),
        stated,
    )
    files = list[Element]()
    around = list[Element]()
    for run in one.runs:
        number = _run_key(run.folder, judged)
        paths = {name: run.folder / name for name in (RESULT_FILE, ROLLOUTS)}
        paths = {name: path for name, path in paths.items() if path.is_file()}
        digests = {name: file_digest(path) for name, path in paths.items()}
        files += _files(number, paths, digests)
        around += [
            Element(f"C-{number}-model", _model(run.result)),
            *_assumptions(run.result, number),
        ]
    if one.runs and hazard.uncertainty == "sampling":
        taken = "The error model is right, and so is how misses hang together"
        around.append(Element(f"A-{key}-model", taken))
    violation = _factor(
        f"G-{key}-violation",
        FACTORS["violation"],
        None if risk is None else risk.violation.high,
        violation_source(one) if risk is not None else one.unknown,
        tuple(file.name for file in files) or stated,
    )
    violation = replace(violation, in_context_of=tuple(element.name for element in around))
    if hazard.harm.intercept is not None and hazard.harm.impact_speed is None:
        rollouts = (file.name for file in files if file.name.endswith("rollouts"))
        harm = replace(harm, supported_by=(*harm.supported_by, *rollouts) if risk else ())
    bound = "not known" if risk is None else f"at most {end_text(risk.harm_per_hour.high)}"
    goal = Element(
        f"G-{key}", f"{hazard.name}: harm an hour is {bound}", supported_by=(f"S-{key}",)
    )
    strategy = Element(
        f"S-{key}",
        "Product: encounters an hour x P(violation) x P(harm)",
        supported_by=(encounters.name, violation.name, harm.name),
    )
    return (goal, strategy, encounters, violation, harm, *files, *around)


def _run_key(folder: Path, judged: JudgedBudget) -> str:
    """A run's number among the budget's, which hazards share."""
    folders = dict.fromkeys(run.folder for one in judged.hazards for run in one.runs)
    return f"run{list(folders).index(folder) + 1}"


def _factor(
    name: str, what: str, high: float | None, source: str, support: tuple[str, ...]
) -> Element:
    bound = "is bounded" if high is None else f"is at most {end_text(high)}"
    return Element(
        name,
        f"{what} {bound} ({source})",
        supported_by=() if high is None else support,
        undeveloped=high is None,
        details={CLAIM: what},
    )
