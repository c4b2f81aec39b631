"""The gate of a pipeline: never a silent pass."""

import sys

from pemviz.reports.gate import GateDecision


def gate_exit_code(decision: GateDecision) -> int:
    """Say what the gate says, and give the exit code for it."""
    print(f"pemviz: gate {decision.sentence}", file=sys.stderr)
    return decision.exit_code
