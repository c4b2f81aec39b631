"""Results as text for people and pipelines: pure functions, and the observer that writes them."""
