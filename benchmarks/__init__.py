"""How fast pemviz is, and how right its answers are: measured beside the package, not within it."""
