"""The errors a user can act on; each message is one line: what, where, allowed."""


class PemvizError(Exception):
    """Base of every error that pemviz raises on purpose."""


class InputError(PemvizError):
    """Something the user gave is wrong; the command line exits with code 2."""


class ConfigError(InputError):
    """A configuration value is unknown, out of range or contradicts another."""


class RunError(PemvizError):
    """A run could not be carried to its end; the command line exits with code 3."""
