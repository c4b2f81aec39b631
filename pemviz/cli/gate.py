"""The gate of a pipeline: never a silent pass."""

import sys

from pemviz.reports.gate import decide_run
from pemviz.runs.result import RunResult


def gate_exit_code(result: RunResult, *, fail_above: float) -> int:
    """1 if the upper bound is above ``fail_above``, 4 if the run cannot tell, else 0."""
    decision = decide_run(result, limit=fail_above)
    print(f"pemviz: gate {decision.sentence}", file=sys.stderr)
    return decision.exit_code
