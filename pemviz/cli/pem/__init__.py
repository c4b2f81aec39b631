"""``pemviz pem``: a module a command."""
