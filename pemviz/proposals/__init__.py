"""Distributions that perception outcomes are sampled from."""
