"""What a run's answer claims: a bound for each source of uncertainty, under what that grants."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from pemviz.reports.estimate_words import end_text
from pemviz.runs.result import RunResult
from pemviz.runs.uncertainty import SourceKind, run_interval_caveats, uncertainty_budget

Verdict = Literal["shown", "not shown", "not known"]
GRANTED: Mapping[SourceKind, str] = {
    "sampling": "the error model {pem} and the simulation are right",
    "lost": "rollouts that could not be simulated may violate or not, and nothing else is wrong",
    "refits": "any refit of {pem} to its data may be right",
    "model-classes": "any of the other shipped kinds of error model may be right",
    "memory": "misses may hang together in time, and objects differ, as far as was looked at",
    "data": "of the model no more is granted than that P(missed) is constant in each band of its "
    "data, and misses are as assumed",
}
"""What each source takes for granted, beside the assumptions below."""


@dataclass(frozen=True)
class Claim:
    """A bound that rests on a source of uncertainty and takes something for granted.

    Attributes:
        bound: The failure probability is below; ``None`` where it is not known, or the rollouts'
            diagnostics undermine it.
        verdict: Whether the wanted claim follows; ``None`` where none was named.
        note: What speaks against the bound, or what would be needed to have one.
    """

    kind: SourceKind
    granted: str
    bound: float | None
    name: str
    verdict: Verdict | None
    note: str

    @property
    def bound_text(self) -> str:
        """The bound in words."""
        return "not known" if self.bound is None else end_text(self.bound)


def claims(result: RunResult, *, below: float | None) -> list[Claim]:
    """A statement for each source of uncertainty but the reference, sampling first."""
    found: list[Claim] = []
    for source in uncertainty_budget(result):
        if source.kind == "reference":
            continue
        of_rollouts = source.kind in ("sampling", "lost", "refits", "model-classes")
        doubts = "; ".join(run_interval_caveats(result)) if of_rollouts else ""
        bound = None if doubts else source.high  # what is no interval bounds nothing
        verdict: Verdict | None = None
        if below is not None and bound is None:
            verdict = "not known"
        elif below is not None and bound is not None:
            verdict = "shown" if bound <= below else "not shown"
        note = doubts or (source.narrowed_by if bound is None else "")
        granted = GRANTED[source.kind].format(pem=result.pem.name)
        if result.is_of_detector_itself:
            granted = "rendered images and the simulation are right"
        found.append(Claim(source.kind, granted, bound, source.name, verdict, note))
    return found


def claim_sentence(result: RunResult, *, below: float | None) -> str:
    """The claim and how far it carries, in a sentence."""
    if result.estimate is None:
        return f"The run {result.status}: it has no estimate, and nothing can be claimed."
    found = claims(result, below=below)
    if below is None:
        highest = [claim for claim in found if claim.bound is not None]
        if not highest:
            doubts = "; ".join(dict.fromkeys(claim.note for claim in found if claim.note))
            return f"No upper bound is known: {doubts}." if doubts else "No upper bound is known."
        last = max(highest, key=lambda claim: claim.bound or 0.0)
        return (
            "No failure probability was named to be claimed. What holds under the least that is "
            f"taken for granted here: {claimed(result)} with a probability below "
            f"{last.bound_text}, if {last.granted}."
        )
    parts = [f"To be claimed: {claimed(result)} with a probability below {below:g}."]
    for verdict in ("shown", "not shown", "not known"):
        granted = [claim.granted for claim in found if claim.verdict == verdict]
        if granted:
            parts.append(f"{verdict.capitalize()} if {'; or if '.join(granted)}.")
    return " ".join(parts)


def claimed(result: RunResult) -> str:
    """What claims are about: of several rules, whether any is broken."""
    rules = len(result.config.rules)
    return f"a run breaks any of {rules} rules" if rules > 1 else "a run violates the specification"
