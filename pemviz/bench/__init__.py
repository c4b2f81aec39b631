"""Measurements of pemviz's own speed."""
