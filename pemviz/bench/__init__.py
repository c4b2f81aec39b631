"""Measurements of speed, each a ratio or a median of one run on this machine."""
