"""The commands of ``pemviz pem``: a dataclass of arguments and a ``run`` for each."""
