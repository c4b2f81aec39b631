"""How rollouts are drawn: here, on a device, or by worker processes."""
