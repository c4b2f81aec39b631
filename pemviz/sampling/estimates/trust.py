"""Whether an interval may be read as a 95 % interval, and so whether it may decide anything.

Decided here, asked by all that show one and by the gate.
"""

from collections.abc import Iterable

from pemviz.errors import ConfigError
from pemviz.sampling.description import IntervalBasis, MethodDescription
from pemviz.sampling.estimates.diagnostics import reason, undermining
from pemviz.sampling.registry import by_name
from pemviz.types import Diagnostic, Estimate

STRICTEST: IntervalBasis = "weights"
"""What the interval of a method is taken to rest on that is not known here."""


def interval_caveats(
    estimate: Estimate, diagnostics: Iterable[Diagnostic] | None = None
) -> tuple[str, ...]:
    """Why ``ci_low`` and ``ci_high`` are no interval at ``confidence``; empty if they are one.

    An estimate whose interval is none decides nothing: the gate, claims and all that call an answer
    reliable ask here too.

    Args:
        estimate: Whose interval.
        diagnostics: All that is known to be wrong; ``None``: the estimate's own.
    """
    wrong = estimate.diagnostics if diagnostics is None else diagnostics
    return caveats(wrong, method=estimate.method)


def remedy(method: str, *, latents: bool = False) -> str:
    """What to try where an answer of ``method`` is not to be trusted, in words.

    Args:
        method: By name.
        latents: Whether the scenario has latents, so that no method runs through its states.
    """
    described = _description(method)
    if described is None:
        return "another method"
    return (described.remedy_with_latents if latents else None) or described.remedy


def rests_on_weights(method: str) -> bool:
    """Whether estimates of ``method`` average weights; not of one that is not installed here."""
    described = _description(method)
    return described is not None and described.rests_on_weights


def caveats(diagnostics: Iterable[Diagnostic], *, method: str) -> tuple[str, ...]:
    """Why an interval of ``method`` with these diagnostics does not hold at its level.

    What the method's description says of its intervals comes last: it holds of all of them.
    """
    described = _description(method)
    basis = STRICTEST if described is None else described.interval_basis
    reasons = tuple(map(reason, undermining(diagnostics, basis=basis)))
    of_method = None if described is None else described.interval_caveat
    return reasons if of_method is None else (*reasons, of_method)


def _description(method: str) -> MethodDescription | None:
    """``None`` for a method that is not installed here: a recording may come from elsewhere."""
    try:
        return by_name(method)
    except ConfigError:
        return None
