"""Method ``auto``: plain rollouts for as long as they pay, then proposals."""
