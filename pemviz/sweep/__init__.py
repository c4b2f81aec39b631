"""Many experiments at once: every combination of settings with every seed, on many processes."""
