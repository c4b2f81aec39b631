"""From weighted rollouts to an estimate with its interval and diagnostics."""
