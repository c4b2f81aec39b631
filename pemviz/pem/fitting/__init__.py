"""Training of each kind of perception error model."""
