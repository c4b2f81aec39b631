"""How likely is a rare violation of a perception-driven controller, and why."""

__version__ = "0.1.0"
