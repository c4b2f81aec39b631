"""The probabilities that a pipeline's gate allows, and how they are written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

from pemviz.config.ranges import Range, check_value
from pemviz.config.settings import Rule
from pemviz.errors import ConfigError

Limit = Annotated[float, Range(low=0.0, low_open=True, high=1.0)]


@dataclass(frozen=True)
class GateLimits:
    """Probabilities that must not be exceeded.

    Attributes:
        overall: By the violation of the specification; ``None``: not asked.
        rules: By that of single rules, by name.
    """

    overall: float | None = None
    rules: Mapping[str, float] = field(default_factory=dict[str, float])


def read_limits(words: Sequence[str], *, rules: Sequence[Rule]) -> GateLimits:
    """What ``P`` and ``NAME=P`` ask for; of several for the same the last holds.

    Raises:
        ConfigError: Something is no probability, or names no rule.
    """
    names = [rule.name for rule in rules]
    found: dict[str, float] = {}
    for word in words:
        name, equals, value = word.rpartition("=")
        if equals and name not in names:
            known = ", ".join(names) or "there are none"
            message = f"fail-above = {word!r}: must name one of the rules ({known})"
            raise ConfigError(message)
        found[name] = _limit(value)
    overall = found.pop("", None)
    return GateLimits(overall, found)


def _limit(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        message = f"fail-above = {text!r}: must be a number above 0 and at most 1"
        raise ConfigError(message) from error
    check_value(name="fail-above", value=value, annotation=Limit)
    return value
