"""The gate of a pipeline: never a silent pass."""

import sys

from pemviz.reports.gate import decide_gate
from pemviz.types import Estimate


def gate_exit_code(estimate: Estimate, *, fail_above: float) -> int:
    """1 if the upper bound is above ``fail_above``, 4 if the estimate cannot tell, else 0."""
    decision = decide_gate(estimate, limit=fail_above)
    print(f"pemviz: gate {decision.sentence}", file=sys.stderr)
    return decision.exit_code
