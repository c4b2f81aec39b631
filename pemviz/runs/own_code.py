"""Which code of the user's own a result rests on."""

import inspect
from importlib import metadata
from pathlib import Path
from typing import Any

from pemviz.files.atomic import file_digest
from pemviz.runs.experiment import Experiment
from pemviz.runs.result import OwnSystem
from pemviz.simulators.latents import parts_of

WRAPPING = ("pemviz", "gymnasium")
"""Packages whose classes hold a user's."""


def own_system(experiment: Experiment) -> OwnSystem | None:
    """What a simulator of the user's own is and where it comes from; ``None``: it is shipped."""
    if not experiment.is_own_system:
        return None
    declared, part = experiment.declared, innermost(experiment.declared)
    kind = type(part)
    if kind.__module__.split(".")[0] == "pemviz":  # encounters, which are shipped
        return None
    source = _source_file(kind)
    package = _package(kind.__module__) if source and "site-packages" in source.parts else None
    return OwnSystem(
        name=declared.name,
        states=declared.states,
        dt_s=float(declared.dt_s),
        code=f"{kind.__module__}.{kind.__qualname__}",
        package=package,
        source_digest=None if source is None else file_digest(source),
    )


def innermost(simulator: Any) -> Any:
    """The user's own code beneath pemviz's wrappers and adapters, and gymnasium's."""
    *parts, last = parts_of(simulator)
    own = (part for part in parts if type(part).__module__.split(".")[0] not in WRAPPING)
    return next(own, last)


def _source_file(kind: type) -> Path | None:
    try:
        found = inspect.getsourcefile(kind)
    except (TypeError, OSError):  # of an interactive session, or compiled
        return None
    return Path(found) if found is not None and Path(found).is_file() else None


def _package(module: str) -> str | None:
    """Name and version of the package that brings a module."""
    names = metadata.packages_distributions().get(module.split(".", maxsplit=1)[0], ())
    return next((f"{name} {metadata.version(name)}" for name in names), None)
