"""What the command line's exit code says."""

EXIT_DONE = 0
EXIT_GATE_TRIPPED = 1
EXIT_BAD_INPUT = 2
EXIT_FAILED = 3
EXIT_GATE_UNDECIDED = 4
