"""What a page asks for, read with care: a message need not come from our own page."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pemviz.errors import InputError

MOST_CHARACTERS = 100_000
"""Of a text in a message."""


class Arguments:
    """The arguments of a request by name; each getter refuses what it is not."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values

    def text(self, name: str, default: str | None = None) -> str:
        """A text, of at most :data:`MOST_CHARACTERS`.

        Raises:
            InputError: It is none, or is absent without a default.
        """
        value = self._values.get(name, default)
        if not isinstance(value, str) or len(value) > MOST_CHARACTERS:
            message = f"{name} = {_shown(value)}: must be a text"
            raise InputError(message)
        return value

    def choice(self, name: str, choices: Sequence[str], default: str | None = None) -> str:
        """One of some words.

        Raises:
            InputError: It is none of them.
        """
        value = self.text(name, default)
        if value not in choices:
            message = f"{name} = {_shown(value)}: must be one of {', '.join(choices)}"
            raise InputError(message)
        return value

    def number(self, name: str, low: float, high: float, default: float | None = None) -> float:
        """A finite number from ``low`` to ``high``.

        Raises:
            InputError: It is none, or is absent without a default.
        """
        value = self._values.get(name, default)
        known = isinstance(value, int | float) and not isinstance(value, bool)
        if not known or not math.isfinite(value) or not low <= value <= high:
            message = f"{name} = {_shown(value)}: must be a number from {low:g} to {high:g}"
            raise InputError(message)
        return float(value)

    def whole(self, name: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number from ``low`` to ``high``.

        Raises:
            InputError: It is none, or is absent without a default.
        """
        value = self.number(name, low, high, default)
        if value != int(value):
            message = f"{name} = {value:g}: must be a whole number from {low} to {high}"
            raise InputError(message)
        return int(value)

    def flag(self, name: str, default: bool = False) -> bool:
        """Yes or no.

        Raises:
            InputError: It is neither.
        """
        value = self._values.get(name, default)
        if not isinstance(value, bool):
            message = f"{name} = {_shown(value)}: must be true or false"
            raise InputError(message)
        return value

    def texts(self, name: str, most: int) -> tuple[str, ...]:
        """At most ``most`` texts.

        Raises:
            InputError: It is no list of so many texts.
        """
        values = self._values.get(name, ())
        is_list = isinstance(values, list | tuple) and len(values) <= most
        if not is_list or not all(isinstance(v, str) and len(v) <= 1000 for v in values):
            message = f"{name} = {_shown(values)}: must be a list of at most {most} texts"
            raise InputError(message)
        return tuple(values)

    def mapping(self, name: str) -> Mapping[str, Any]:
        """Values by name.

        Raises:
            InputError: It is none.
        """
        values = self._values.get(name, {})
        if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
            message = f"{name} = {_shown(values)}: must be values by name"
            raise InputError(message)
        return values


def _shown(value: object) -> str:
    return repr(value)[:60]
