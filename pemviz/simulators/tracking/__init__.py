"""A tracker between perception and controller, and what proposals see of it."""
