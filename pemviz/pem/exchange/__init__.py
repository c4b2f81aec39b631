"""Fitted error models as the tables that other simulators take, and back."""
