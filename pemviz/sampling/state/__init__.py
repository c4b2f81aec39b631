"""What perception hides: properties that outcomes tell of, as part of a system's state."""
