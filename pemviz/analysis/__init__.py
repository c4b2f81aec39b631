"""What a run says beyond its estimate: causes, sensitivity, other error models."""
