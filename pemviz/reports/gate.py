"""The decision of a pipeline's gate: never a silent pass."""

from dataclasses import dataclass
from typing import Literal

from pemviz.runs.result import RunResult
from pemviz.sampling.estimates.diagnostics import reason, undermining
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

GateOutcome = Literal["passed", "tripped", "undecided"]


@dataclass(frozen=True)
class GateDecision:
    """What the gate says.

    Attributes:
        outcome: ``tripped`` if the upper bound is above the limit; ``undecided`` if the
            estimate cannot tell.
        limit: The probability that must not be exceeded.
        reason: In words.
    """

    outcome: GateOutcome
    limit: float
    reason: str

    @property
    def sentence(self) -> str:
        """Outcome and reason."""
        words = {"undecided": "cannot be decided"}.get(self.outcome, self.outcome)
        return f"{words}: {self.reason}"


def decide_gate(estimate: Estimate, *, limit: float) -> GateDecision:
    """Compare an estimate's upper bound with ``limit``."""
    upper = estimate.ci_high
    if upper is None:
        return GateDecision("undecided", limit, "there is no upper bound")
    bound = f"the upper {estimate.confidence:.0%} bound {upper:.3g}".replace("%", " %")
    if upper > limit:
        return GateDecision("tripped", limit, f"{bound} is above {limit:g}")
    reasons = unreliable_because(estimate)
    if reasons:
        return GateDecision("undecided", limit, "; ".join(reasons))
    return GateDecision("passed", limit, f"{bound} is not above {limit:g}")


def decide_run(result: RunResult, *, limit: float) -> GateDecision:
    """The gate's decision on a run; one that did not finish decides nothing."""
    if result.status != "done":
        message = result.message or "what was finished is in the run folder"
        return GateDecision("undecided", limit, f"the run {result.status} ({message})")
    if result.estimate is None:
        return GateDecision("undecided", limit, "there is no estimate")
    return decide_gate(result.estimate, limit=limit)


def unreliable_because(estimate: Estimate) -> tuple[str, ...]:
    """Why an estimate must not decide anything; empty if nothing speaks against it."""
    basis = by_name(estimate.method).interval_basis
    return tuple(map(reason, undermining(estimate.diagnostics, basis=basis)))
