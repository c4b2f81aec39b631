"""Parts of an experiment that are chosen by name: shipped, or registered by installed packages.

A package registers one in its ``pyproject.toml``, for instance a method::

    [project.entry-points."pemviz.methods"]
    my-method = "my_package.method:DESCRIPTION"
"""

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Any

from pemviz.errors import ConfigError
from pemviz.faults import told


@dataclass(frozen=True)
class NamedPart:
    """A kind of part, the names that are shipped, and where packages register more.

    As an annotation of a text field it says which values the field may have.

    Attributes:
        kind: What it is, as messages and the configuration name it, e.g. ``method``.
        group: The entry points' group: ``pemviz.`` and the kind in the plural.
        shipped: Names that this package has; they go before registered ones of the same name.
    """

    kind: str
    group: str
    shipped: tuple[str, ...]

    def names(self) -> tuple[str, ...]:
        """All names: shipped ones first, then registered ones in alphabetical order."""
        registered = {point.name for point in metadata.entry_points(group=self.group)}
        return (*self.shipped, *sorted(registered - {*self.shipped}))

    def complaint(self, name: object) -> str | None:
        """What is wrong with a name, and which there are; ``None`` if it is one of them."""
        if name in self.shipped:
            return None
        names = self.names()
        if name in names:
            return None
        near = difflib.get_close_matches(name, names, n=1) if isinstance(name, str) else []
        guess = f"did you mean {near[0]}? There" if near else "there"
        return f"no such {self.kind}; {guess} are: {', '.join(names)}"

    def registered(
        self,
        name: str,
        *,
        made: Callable[[Any], Any],
        fits: Callable[[Any], bool],
        complaint: str,
    ) -> Any:
        """What a package registers under ``name``.

        Args:
            name: Its name.
            made: What the entry point names, to the part itself.
            fits: Whether it is such a part.
            complaint: What to say where it is not, ``{}`` standing for what it is instead.

        Raises:
            ConfigError: There is none, two packages register it, or it cannot be loaded, made
                or used.
        """
        points = {
            point.value: point for point in metadata.entry_points(group=self.group, name=name)
        }
        where = f"{self.kind} = {name!r}"
        if not points:
            message = f"{where}: {self.complaint(name)}"
            raise ConfigError(message)
        if len(points) > 1:
            message = f"{where}: registered more than once, as {' and '.join(points)}"
            raise ConfigError(message)
        (point,) = points.values()
        try:
            part = made(point.load())
            is_fit = fits(part)
        except BaseException as error:  # code of another package may raise anything
            message = f"{where}: {point.value} raises {told(error)}"
            raise ConfigError(message) from error
        if not is_fit:
            message = f"{where}: {point.value} {complaint.format(described(part))}"
            raise ConfigError(message)
        return part


def described(part: object) -> str:
    """What something is, for a message that says that it should be something else."""
    if isinstance(part, type):
        return f"the class {part.__name__}"
    return "nothing" if part is None else f"a value of type {type(part).__name__}"
