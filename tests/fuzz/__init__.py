"""Damaged inputs at random: nothing but documented errors may come out.

``python -m tests.fuzz --cases 100000`` runs all targets; a case is named by target and seed.
"""
