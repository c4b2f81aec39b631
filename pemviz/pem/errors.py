"""The error of this package."""

from pemviz.errors import InputError


class PemError(InputError):
    """A perception error model, or the data for one, cannot be used; one line says why."""
