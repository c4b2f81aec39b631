"""How good a perception error model is, and where its data carries it."""
