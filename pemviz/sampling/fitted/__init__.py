"""Fitted proposals drawn from by a compiled loop."""
