"""Method ``value-twisted`` and the reference: exact values of the reachable states."""
