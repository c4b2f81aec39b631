"""How rollouts are drawn: here, or by worker processes."""
