"""Method ``splitting``: multilevel splitting."""
