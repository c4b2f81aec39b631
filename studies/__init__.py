"""What was worked out with pemviz, by programs that its users do not need."""
