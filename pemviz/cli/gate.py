"""The gate of a pipeline: never a silent pass."""

import sys

from pemviz.cli.exit_codes import EXIT_DONE, EXIT_GATE_TRIPPED, EXIT_GATE_UNDECIDED
from pemviz.reports.gate import decide_run
from pemviz.runs.result import RunResult

EXIT_CODES = {
    "passed": EXIT_DONE,
    "tripped": EXIT_GATE_TRIPPED,
    "undecided": EXIT_GATE_UNDECIDED,
}


def gate_exit_code(result: RunResult, *, fail_above: float) -> int:
    """1 if the upper bound is above ``fail_above``, 4 if the run cannot tell, else 0."""
    decision = decide_run(result, limit=fail_above)
    print(f"pemviz: gate {decision.sentence}", file=sys.stderr)
    return EXIT_CODES[decision.outcome]
