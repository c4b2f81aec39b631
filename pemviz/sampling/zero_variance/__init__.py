"""Method ``zero-variance`` and the reference: exact values of the reachable states."""
