"""Methods ``monte-carlo`` and ``naive``: nothing is learned."""
