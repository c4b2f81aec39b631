"""The kinds of perception error models, evaluated by numpy."""
