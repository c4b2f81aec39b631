"""How far a run's answer is to be trusted: by its own diagnostics, and beside the reference."""

from pemviz.runs.result import RunResult
from pemviz.sampling.estimates.diagnostics import reference_disagreement, unreliable_reference
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Diagnostic


def run_diagnostics(result: RunResult) -> tuple[Diagnostic, ...]:
    """What is wrong with a run's answer: with its estimate, and beside the reference."""
    own = () if result.estimate is None else result.estimate.diagnostics
    return (*own, *reference_diagnostics(result))


def reference_diagnostics(result: RunResult) -> tuple[Diagnostic, ...]:
    """What is wrong with a run's answer beside the reference; nothing without one."""
    estimate, reference = result.estimate, result.reference
    if estimate is None or reference is None:
        return ()
    disagreement = reference_disagreement(
        estimate,
        probability=reference.probability,
        std_error=reference.std_error,
        trusted=not reference.warnings,
    )
    return (*disagreement, *unreliable_reference(reference.warnings))


def run_interval_caveats(result: RunResult) -> tuple[str, ...]:
    """Why the answer's interval is no 95 % interval, and the answer decides nothing.

    Empty if it is one, or there is none.
    """
    if result.estimate is None:
        return ()
    return interval_caveats(result.estimate, run_diagnostics(result))


def data_warnings(result: RunResult) -> tuple[str, ...]:
    """What is said about the error model, its data and its refits, in words."""
    about_answer = {diagnostic.text for diagnostic in run_diagnostics(result)}
    about_refits = () if result.pem_interval is None else result.pem_interval.warnings
    own = (warning for warning in result.warnings if warning not in about_answer)
    return (*own, *about_refits)
