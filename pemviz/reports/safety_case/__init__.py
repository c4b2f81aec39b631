"""A page for a safety case: claim, argument, evidence, assumptions, data, provenance."""
