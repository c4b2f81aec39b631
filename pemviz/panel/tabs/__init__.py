"""The panel's tabs, one a module."""
