"""Sampling methods, importance weights and estimates."""
