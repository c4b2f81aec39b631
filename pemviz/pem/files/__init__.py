"""Perception error models on disk, with their cards."""
