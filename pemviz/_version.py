"""The version, for the package's metadata and for everything that records or compares it."""

__version__ = "0.1.0"
