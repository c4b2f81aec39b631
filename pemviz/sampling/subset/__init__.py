"""Method ``subset``: subset simulation."""
