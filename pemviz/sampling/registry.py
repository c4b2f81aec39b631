"""Methods by name: those shipped, and those that installed packages register.

A package registers one in its ``pyproject.toml``::

    [project.entry-points."pemviz.methods"]
    my-method = "my_package.method:DESCRIPTION"

where ``DESCRIPTION`` is a :class:`pemviz.sampling.description.MethodDescription` of that name,
whose ``build`` returns a :class:`pemviz.sampling.method.Method`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pemviz.config import METHODS, ExperimentConfig
from pemviz.errors import ConfigError, InputError
from pemviz.faults import exception_text
from pemviz.sampling.adaptive.description import ADAPTIVE
from pemviz.sampling.auto.description import AUTO
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.direct.description import MONTE_CARLO, NAIVE
from pemviz.sampling.mixture.description import MIXTURE
from pemviz.sampling.splitting.description import SPLITTING
from pemviz.sampling.subset.description import SUBSET
from pemviz.sampling.zero_variance.description import ZERO_VARIANCE

if TYPE_CHECKING:
    from pemviz.sampling.back_end import BackEnd
    from pemviz.sampling.method import Method

SHIPPED = (AUTO, ADAPTIVE, MIXTURE, ZERO_VARIANCE, SPLITTING, SUBSET, MONTE_CARLO, NAIVE)
METHOD_MEMBERS = ("name", "stages", "init", "step", "is_done", "estimate")


def by_name(name: str) -> MethodDescription:
    """The description of the method ``name``; a shipped one goes before a registered one.

    Raises:
        ConfigError: There is none, two packages register it, or what is registered is no
            description of a method of that name.
    """
    for shipped in SHIPPED:
        if shipped.name == name:
            return shipped
    description: MethodDescription = METHODS.registered(
        name,
        made=lambda registered: registered,
        fits=lambda registered: isinstance(registered, MethodDescription),
        complaint="is {}, which is no pemviz.MethodDescription",
    )
    if description.name != name:
        message = f"method = {name!r}: what is registered describes method {description.name!r}"
        raise ConfigError(message)
    return description


def ignored_settings(name: str) -> frozenset[str]:
    """Fields of the configuration that other methods look at and the method ``name`` does not.

    None of one that is registered, which is not imported before it runs.
    """
    looked_at = {method.name: method.settings for method in SHIPPED}
    if name not in looked_at:
        return frozenset()
    return frozenset[str]().union(*looked_at.values()) - looked_at[name]


def ignored_note(name: str) -> str:
    """That the method ``name`` does not look at a setting, and at which it does."""
    return f"{name} does not look at it, but at {', '.join(sorted(by_name(name).settings))}"


def build_named_method(config: ExperimentConfig, back_end: BackEnd) -> Method[Any]:
    """The method that ``config`` names, on a back end that has what it needs.

    Raises:
        ConfigError: There is none of that name, or it cannot be built.
    """
    description = by_name(config.method)
    try:
        method = description.build(config, back_end)
        lacks = [member for member in METHOD_MEMBERS if not hasattr(method, member)]
    except InputError:
        raise
    except BaseException as error:  # code of another package may raise anything
        if description in SHIPPED:
            raise
        message = f"method = {config.method!r}: building it raises {exception_text(error)}"
        raise ConfigError(message) from error
    if lacks:
        message = f"method = {config.method!r}: what is built has no {' and no '.join(lacks)}"
        raise ConfigError(message)
    return method
