"""What a run lets one claim, by how much one is ready to take for granted."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from pemviz.runs.result import RunResult
from pemviz.runs.trust import run_interval_caveats
from pemviz.runs.uncertainty import SourceKind, UncertaintySource, uncertainty_budget

Verdict = Literal["shown", "not shown", "not known"]
GRANTED: Mapping[SourceKind, str] = {
    "sampling": "the error model {pem} and the simulation are right",
    "refits": "any refit of {pem} to its data may be right",
    "model-classes": "any of the other shipped kinds of error model may be right",
    "memory": "misses may hang together in time, and obstacles differ, as far as was looked at",
    "data": "of the model no more is granted than that P(missed) is constant in bands of distance, "
    "and misses are as assumed",
}
"""What each source takes for granted, beside the assumptions below."""


@dataclass(frozen=True)
class Claim:
    """One statement.

    Attributes:
        kind: The source that it rests on.
        granted: What it takes for granted.
        bound: The failure probability is below; ``None`` where it is not known.
        name: The source's name, with its level.
        verdict: Whether the wanted claim follows; ``None`` where none was named.
        note: What speaks against the bound, or what would be needed to have one.
    """

    kind: SourceKind
    granted: str
    bound: float | None
    name: str
    verdict: Verdict | None
    note: str


def claims(result: RunResult, *, below: float | None) -> list[Claim]:
    """A statement for each source of uncertainty but the reference, sampling first.

    Args:
        result: The run.
        below: The failure probability that is to be claimed, if one is named.
    """
    doubts = "; ".join(run_interval_caveats(result))
    against: Mapping[SourceKind, str] = dict.fromkeys(
        ("sampling", "refits", "model-classes"), doubts
    )
    return [
        _claim(source, pem=result.pem.name, below=below, doubted=against.get(source.kind, ""))
        for source in uncertainty_budget(result)
        if source.kind != "reference"
    ]


def _claim(source: UncertaintySource, *, pem: str, below: float | None, doubted: str) -> Claim:
    verdict: Verdict | None = None
    if below is not None and (source.high is None or doubted):
        verdict = "not known"
    elif below is not None and source.high is not None:
        verdict = "shown" if source.high <= below else "not shown"
    note = doubted or (source.narrowed_by if source.high is None else "")
    granted = GRANTED[source.kind].format(pem=pem)
    return Claim(source.kind, granted, source.high, source.name, verdict, note)


def claim_sentence(result: RunResult, *, below: float | None) -> str:
    """The claim and how far it carries, in a sentence."""
    if result.estimate is None:
        return f"The run {result.status}: it has no estimate, and nothing can be claimed."
    found = claims(result, below=below)
    if below is None:
        highest = [claim for claim in found if claim.bound is not None]
        if not highest:
            return "No upper bound is known."
        last = max(highest, key=lambda claim: claim.bound or 0.0)
        return (
            "No failure probability was named to be claimed. What holds under the least that is "
            f"taken for granted here: below {last.bound:.2g}, if {last.granted}."
        )
    shown, not_shown, unknown = (
        [claim.granted for claim in found if claim.verdict == verdict]
        for verdict in ("shown", "not shown", "not known")
    )
    parts = [f"To be claimed: a run violates the specification with a probability below {below:g}."]
    if shown:
        parts.append(f"Shown if {_each(shown)}.")
    if not_shown:
        parts.append(f"Not shown if {_each(not_shown)}.")
    if unknown:
        parts.append(f"Not known if {_each(unknown)}.")
    return " ".join(parts)


def _each(granted: list[str]) -> str:
    return "; or if ".join(granted)
