"""Rare events that nobody here designed: published problems, and others' programs beside pemviz."""
