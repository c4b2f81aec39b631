"""The gate of a pipeline: never a silent pass."""

import sys

from pemviz.cli.exit_codes import EXIT_DONE, EXIT_GATE_TRIPPED, EXIT_GATE_UNDECIDED
from pemviz.reports.gate import decide_gate
from pemviz.types import Estimate

EXIT_CODES = {
    "passed": EXIT_DONE,
    "tripped": EXIT_GATE_TRIPPED,
    "undecided": EXIT_GATE_UNDECIDED,
}


def gate_exit_code(estimate: Estimate, *, fail_above: float) -> int:
    """1 if the upper bound is above ``fail_above``, 4 if the estimate cannot tell, else 0."""
    decision = decide_gate(estimate, limit=fail_above)
    print(f"pemviz: gate {decision.sentence}", file=sys.stderr)
    return EXIT_CODES[decision.outcome]
