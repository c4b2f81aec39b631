"""A perception error model that is a Python object of the user's, imported only if allowed."""

import re
from importlib import import_module

from pemviz.errors import PemError
from pemviz.faults import told
from pemviz.pem.models.protocol import Pem

_OBJECT_NAME = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")


def is_object_name(text: str) -> bool:
    """Whether the text has the form ``module:attribute``."""
    return _OBJECT_NAME.fullmatch(text) is not None


def load_object(text: str, *, allowed: bool) -> Pem:
    """Import ``module:attribute``, which runs the module's code.

    Args:
        text: for example ``mydetector.pem:MODEL``; a class or function without arguments there
            is called.
        allowed: whether the user said that code may run.

    Raises:
        PemError: not allowed, not importable, or no perception error model.
    """
    if not allowed:
        raise PemError(
            f"{text!r} would run Python code: allow that on the command line (--allow-python), "
            "or give a file"
        )
    module_name, attribute = text.split(":")
    try:
        model: object = import_module(module_name)
        for part in attribute.split("."):
            model = getattr(model, part)
        # A class passes for a model by its attributes: it is an instance that answers.
        if isinstance(model, type) or (not isinstance(model, Pem) and callable(model)):
            model = model()
    except BaseException as error:  # the user's code may raise anything
        raise PemError(f"{text!r} cannot be imported: {told(error)}") from error
    if not isinstance(model, Pem):
        raise PemError(
            f"{text!r} is no perception error model: it needs name, digest, data, licence, logit"
        )
    return model
