"""The braking scenario on two back ends: vectorized, and highway-env."""
