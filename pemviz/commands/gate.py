"""The gate of a pipeline: never a silent pass."""

import sys

from pemviz.exit_codes import EXIT_DONE, EXIT_GATE_TRIPPED, EXIT_GATE_UNDECIDED
from pemviz.sampling.diagnostics import unreliable_because
from pemviz.types import Estimate


def gate_exit_code(estimate: Estimate, *, fail_above: float) -> int:
    """1 if the upper bound is above ``fail_above``, 4 if the estimate cannot tell, else 0."""
    upper = estimate.ci_high
    if upper is None:
        return _say(EXIT_GATE_UNDECIDED, "cannot be decided: there is no upper bound")
    if upper > fail_above:
        return _say(
            EXIT_GATE_TRIPPED, f"tripped: the upper 95 % bound {upper:.3g} is above {fail_above:g}"
        )
    reasons = unreliable_because(estimate)
    if reasons:
        return _say(EXIT_GATE_UNDECIDED, f"cannot be decided: {'; '.join(reasons)}")
    return _say(EXIT_DONE, f"passed: the upper 95 % bound {upper:.3g} is not above {fail_above:g}")


def _say(code: int, message: str) -> int:
    print(f"pemviz: gate {message}", file=sys.stderr)
    return code
