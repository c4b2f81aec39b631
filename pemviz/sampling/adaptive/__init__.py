"""Method ``adaptive``: the paper's Algorithm 1."""
