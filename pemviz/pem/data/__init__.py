"""From labels and detections to the table that error models learn from."""
